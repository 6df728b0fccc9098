"""All that solves a step's equations: the nest, its solver and preconditioners, and the options that choose them."""
