"""The network: tokenizers, two experts under one attention, conditioning and flow matching."""
