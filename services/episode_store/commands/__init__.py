"""The words of `dextouch store`, by what they do: look, remove, mend."""
