"""Models and controllers improved from data: excitation and identification."""
