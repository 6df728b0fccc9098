"""A run from its first step to its last: what it would take, what it keeps, how it stops and goes on."""
