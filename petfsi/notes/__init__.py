"""What a scene says that a user should think of before it runs: a function for each, a line for each thing found."""
