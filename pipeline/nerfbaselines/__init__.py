"""Crossray as a method of nerfbaselines, the benchmark that compares methods of this kind: `pip install
crossray[nerfbaselines]`, then `nerfbaselines train --method crossray` (docs/nerfbaselines.md).

spec.py is what nerfbaselines finds, method.py is what it calls; nothing else of Crossray knows of it.
"""

METHOD = "crossray"
FEATURES = ("color", "points3D_xyz")  # of a data set: photos, and the points that depth bounds come from
CAMERAS = ("pinhole",)
OUTPUTS = ("color", "depth", "accumulation")
