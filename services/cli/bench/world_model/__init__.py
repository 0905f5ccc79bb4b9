"""The stage `world-model`: the time of an imagined chunk against its error in the twin's eyes."""
