"""The fluid as particles: weakly compressible smoothed particle hydrodynamics."""
