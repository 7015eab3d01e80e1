"""The version of the package, which artifacts and stage records carry."""

__version__ = "0.1.0"
