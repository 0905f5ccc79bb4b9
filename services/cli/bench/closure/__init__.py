"""What retargeting is worth: human takes of the twin, played again by its robot hand."""
