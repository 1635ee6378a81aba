"""Public identification problems: the plants, the data and the fits."""
