"""The built-in scene: photos of a landmark "in the wild", with ground truth for everything.

collection.py draws the photos and writes them; scene.py is the building, light.py the hour and the camera's response,
crowd.py the tourists, photo.py one photo of it all, tracer.py the rays.
"""

from pipeline.landmark.collection import Landmark, draw_photo, write_landmark

__all__ = ["Landmark", "draw_photo", "write_landmark"]
