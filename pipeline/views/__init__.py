"""Where a picture is taken from: cameras, smooth paths of them, and the files in which they travel."""
