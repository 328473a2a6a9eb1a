"""`crossray view`: a trained scene in a browser, in the light of any photo."""
