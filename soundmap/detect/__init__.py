"""Sources: the local maxima of the power map (Sects. 2.4 and 4)."""
