"""Where photos were taken from: COLMAP models, rigs, boards, structure from motion, resection.

Modules are imported one by one (`from omnilines.posing.sfm import sfm_poses`), since pycolmap is slow to load.
"""
