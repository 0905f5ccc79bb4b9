"""Operators' web page: health, touch and recorder of a station, fed by the services' APIs."""
