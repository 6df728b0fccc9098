"""Many runs of one scene: from a file that says what differs to a folder of runs, and a table of what came out."""
