"""How velocity and smoke are carried along, also on both sides of sheets."""
