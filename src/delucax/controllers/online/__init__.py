"""Controllers that learn while they run. `delucax.controllers` exports them."""
