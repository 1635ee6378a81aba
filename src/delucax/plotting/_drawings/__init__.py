"""How plants look: draw functions, found by the type of the system."""
