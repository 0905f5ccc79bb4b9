"""JPEG encoding of still images."""
