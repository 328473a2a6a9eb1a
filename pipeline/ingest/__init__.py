"""`crossray ingest`: a folder of photos, or photos with a nerfstudio transforms.json -> a posed scene.

folder.py looks at the files, features.py finds and matches features, mapping.py finds poses and doubts them,
undistort.py makes pinhole photos, transforms.py reads and writes nerfstudio's format, summary.py and picture.py tell
how it went, child.py runs native code so that it can be stopped, run.py is the order of it all.
"""

from pipeline.ingest.run import ingest
from pipeline.ingest.summary import Summary

__all__ = ["Summary", "ingest"]
