"""Readers of mesh files: those that others keep, and own ones where these refuse or misread what people have."""
