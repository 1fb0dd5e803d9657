"""A watched folder: what arrives in it is processed once it is complete."""
