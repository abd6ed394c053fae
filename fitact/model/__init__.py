"""What happens on the display, and what is believed of it beforehand: pure JAX that knows no data."""
