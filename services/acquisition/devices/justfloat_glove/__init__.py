"""Tactile gloves that send bare float32s and a tail (VOFA's "justfloat") on a serial line."""
