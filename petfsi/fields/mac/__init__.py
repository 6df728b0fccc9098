"""The fluid on a regular staggered grid."""
