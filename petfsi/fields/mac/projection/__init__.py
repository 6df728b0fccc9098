"""The pressure and what it acts on: its block beside walls, open sides, regions, and a weight at rest."""
