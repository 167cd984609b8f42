"""Results as JSON: result.json of the command line."""

import json
import math

import numpy as np

from ..errors import DataError
from .access import read_text
from .atomic import write_text


def write_result(path, result):
    """Write the dict result to path as JSON; what is not a finite number becomes null. Raises
    DataError.
    """
    write_text(path, result_text(result))


def result_text(result):
    """The dict result as JSON text: two blanks of indentation, keys in their order, no NaN."""
    return json.dumps(plain(result), indent=2, allow_nan=False, ensure_ascii=False) + '\n'


def read_result(path):
    """The dict in a JSON file. Raises DataError that names the row of what is wrong."""
    text = read_text(path)
    try:
        result = json.loads(text)
    except json.JSONDecodeError as error:
        raise DataError(f'{path}, row {error.lineno}: this is not JSON ({error.msg})') from None
    except RecursionError:
        raise DataError(f'{path}: this is not a result, it is nested too deeply') from None
    if not isinstance(result, dict):
        raise DataError(
            f'{path}: this is not a result, it holds a {type(result).__name__} and no object'
        )
    return result


def plain(value):
    """Value with numpy arrays and numbers as lists and Python numbers, and None for what is not
    finite.
    """
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value
