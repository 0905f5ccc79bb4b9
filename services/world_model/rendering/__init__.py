"""Renderer: draws head camera images of the scene states that the world model predicts."""
