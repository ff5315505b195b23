"""Calibrate wide-angle cameras and rebuild straight lines in 3D without undistorting an image."""
