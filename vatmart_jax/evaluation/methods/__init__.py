"""Methods of manipulation, to be compared in the same trials: what chooses contact, approach and waypoints."""
