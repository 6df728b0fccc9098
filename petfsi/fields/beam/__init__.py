"""Beams in the plane: geometrically exact Timoshenko and Hermite Euler-Bernoulli."""
