"""Bringing together the image points of one exposure that bear the same id in several views."""

import numpy as np


def matched(target_ids, uv, sigma, outside=None):
    """Image points of F views by target: ids (n,), uv (F, n, 2) and sigma (F, n) [px], and outside
    (F, n).

    target_ids, uv, sigma and outside: for each view its ids (n_f,), each once, image points (n_f,
    2), standard deviations (n_f,) [px] and, True or False, what lies beyond the calibrated area
    (n_f,); outside None: None is returned. A view has NaN and False where it does not have a
    target; one that is missing, for which all of these are None, throughout. Ids are ascending, or
    where all views have the same in the same order, in that order.
    """
    if any(ids is None for ids in target_ids):
        return _with_gaps(target_ids, uv, sigma, outside)
    target_ids = [np.asarray(ids) for ids in target_ids]
    first = target_ids[0]
    if all(len(ids) == len(first) and (ids == first).all() for ids in target_ids[1:]):
        return (
            first,
            np.array(uv, dtype=float).reshape(len(uv), -1, 2),
            np.array(sigma, dtype=float),
            None if outside is None else np.array(outside, dtype=bool),
        )
    every = np.unique(np.concatenate(target_ids))
    shape = (len(target_ids), len(every))
    out_uv = np.full(shape + (2,), np.nan)
    out_sigma = np.full(shape, np.nan)
    out_outside = None if outside is None else np.zeros(shape, dtype=bool)
    for view, ids in enumerate(target_ids):
        rows = np.searchsorted(every, ids)
        out_uv[view, rows] = uv[view]
        out_sigma[view, rows] = sigma[view]
        if outside is not None:
            out_outside[view, rows] = outside[view]
    return every, out_uv, out_sigma, out_outside


def _with_gaps(target_ids, uv, sigma, outside):
    """As matched, of views of which some are missing."""
    there = [view for view, ids in enumerate(target_ids) if ids is not None]
    ids, *found = matched(
        *([values[view] for view in there] for values in (target_ids, uv, sigma)),
        None if outside is None else [outside[view] for view in there],
    )
    out = []
    for part, missing in zip(found, (np.nan, np.nan, False)):
        if part is not None:
            whole = np.full((len(target_ids), *part.shape[1:]), missing, dtype=part.dtype)
            whole[there] = part
        out.append(None if part is None else whole)
    return ids, *out
