"""Cases that fail today, by what is missing: each is taken from here by who mends it, since one that passes is refused here."""

MISSING: dict[str, tuple[str, ...]] = {
    "results are not yet written through `omnilines.files.folders.claim`": (
        "photos/over:adjust", "photos/over:calibrate", "photos/over:pattern", "photos/over:reconstruct",
        "photos/over:targets",
    ),
    "options that do nothing are not yet refused": (
        "options/calibrate:coefficients='-1'", "options/calibrate:coefficients='3'", "options/ignored:convert:7",
        "options/ignored:corners:0", "options/ignored:corners:1", "options/ignored:corners:2", "options/ignored:corners:3",
        "options/ignored:scene:10", "options/ignored:scene:9", "options/ignored:segments:4", "options/scene:textured='clouds'",
        "options/segments:mask='IN/photos/0.png'", "options/segments:min-views='5'",
        "options/segments:pattern='checkerboard:7x5:30mm'", "options/segments:tolerance-px='2'",
    ),
}  # fmt: skip
REASONS = {name: reason for reason, names in MISSING.items() for name in names}
