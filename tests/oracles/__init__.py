"""Independent programs that results are held against; the product never imports them."""
