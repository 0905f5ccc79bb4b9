"""Mock devices: an episode's streams come in, the bytes that real devices would send go out."""
