"""The drawings of plants, chosen by the type of the system."""
