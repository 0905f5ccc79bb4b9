"""The nouns of DexTouch: what a policy, a station and every service share."""

__version__ = "0.1.0"
