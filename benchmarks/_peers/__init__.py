"""The other contenders. Each module answers `contender(case)` and `simulate(case)`."""
