"""Arcs of straight lines in photos of any calibrated camera.

found = extract_arcs(image, model)          # image (h, w) or (h, w, 3), 8 or 16 bits
found.endpoints_px                          # (n, 2, 2) pixels; found.covariance_px2 (n, 2, 2, 2)
"""

from omnilines.extraction.extract import ExtractedArcs, extract_arcs
from omnilines.extraction.options import ExtractionOptions

__all__ = ["ExtractedArcs", "ExtractionOptions", "extract_arcs"]
