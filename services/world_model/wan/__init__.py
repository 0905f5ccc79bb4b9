"""Pretrained parts of the full-size model: the networks of Wan2.2-TI2V-5B, from local files."""
