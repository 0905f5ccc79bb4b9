"""The station: device bytes come in, spooled and uploaded recordings with their health go out."""
