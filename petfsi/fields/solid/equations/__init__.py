"""The equations of a step, and what they are made of besides elements and loads."""
