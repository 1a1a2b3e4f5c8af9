"""An experiment as data, and the construction of its objects."""
