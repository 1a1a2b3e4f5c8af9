"""One experiment as data, and the objects that it names."""
