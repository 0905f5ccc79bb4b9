"""The stage `acquisition`: glove decoders and serial ports, timed against their errors."""
