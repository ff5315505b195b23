"""One self-contained HTML page per result: `write_report(path, title, [section, ...])`.

Each section is built from plain data by one function; the page makes no network request and is at most 15 MB.
"""

from omnilines.report.curves import coverage_section, curve_section, histogram_section, radial_section
from omnilines.report.next_views import next_views_section
from omnilines.report.page import PAGE_LIMIT_BYTES, Section, write_report
from omnilines.report.photos import photos_section, pictures_section
from omnilines.report.residuals import residual_section
from omnilines.report.scene import scene_section
from omnilines.report.tables import (
    checks_section,
    parameters_section,
    summary_section,
    table_section,
    verdict_section,
    views_section,
)
from omnilines.report.uncertainty import uncertainty_section

__all__ = [
    "PAGE_LIMIT_BYTES",
    "Section",
    "checks_section",
    "coverage_section",
    "curve_section",
    "histogram_section",
    "next_views_section",
    "parameters_section",
    "photos_section",
    "pictures_section",
    "radial_section",
    "residual_section",
    "scene_section",
    "summary_section",
    "table_section",
    "uncertainty_section",
    "verdict_section",
    "views_section",
    "write_report",
]
