"""A search over settings of one config for better ones."""
