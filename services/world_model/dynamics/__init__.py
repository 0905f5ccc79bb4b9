"""State of a scene that lasts: objects found at the start, then moved and felt by a recurrent core."""
