"""The operators' page: health, touch and recorder of a station, from the other services' APIs."""
