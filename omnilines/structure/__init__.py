"""The structure of scenes of straight lines: how regular they are, and which of them are parallel or at right angles."""
