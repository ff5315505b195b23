"""Which frames of a video are worth keeping: how still and sharp each is, and how far the camera has moved."""
