"""What leaves the house: a trained scene in one appearance, as files that other programs open.

shown.py is the field in that appearance, points.py a point cloud of it, depth.py depth maps, cameras.py the views'
cameras as a COLMAP model and as transforms.json, export.py the folder of all of it, readme.py what it says to people.
"""
