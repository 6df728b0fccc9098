"""Shapes, meshes, surfaces and rays."""
