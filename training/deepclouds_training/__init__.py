"""Training side of deepclouds: clouds, labels, data sets, training and export."""
