"""What can go wrong, by kind.

Every message follows one pattern: what it is about (file or argument), what
was expected, what arrived, what to do. The commands print the message alone
and exit with status 2; anything else is a defect and prints its traceback.
"""


class ReflfieldError(Exception):
    """Base of all errors that this package raises on purpose."""


class InputError(ReflfieldError, ValueError):
    """An argument, option or file holds something that cannot be used."""


class ShapeError(InputError):
    """An array has the wrong shape or dtype."""


class CaptureError(InputError):
    """A capture on disk is incomplete, inconsistent or malformed."""


class FieldFileError(InputError):
    """A reflectance field file is not one, is damaged, or is too new."""


class GeometryError(ReflfieldError, ValueError):
    """Silhouettes, hull or atlas do not determine a usable surface."""


class NumericalError(ReflfieldError, ArithmeticError):
    """A computation left the range in which its result means anything."""
