"""Values that are passed around, and the checks on them. Imports no other subpackage."""
