"""The correction at the rate of a stream: a lookup grid made of a correction model once.

A frame of 30 points leaves no time for searches of neighbours or series of sines, and millions of
points even less. So the image is divided into cells, and in each the correction and its standard
deviation are bilinear between their exact values at the corners. A cell is one row of a table,
with everything that a point of it needs: a random access to memory for a point is what a lookup
costs, and the calls of numpy for a small frame. The few cells in which that is not accurate
enough, as smoothers have kinks, are divided once more and have rows in a second table.

Smoothers are evaluated block by block: all pixels of a block have their k nearest training points
among those within r + 2e of its middle, with r the distance of the k-th nearest from there and e
half the diagonal (triangle inequality). So one search serves some 200 pixels, and every call of
numpy takes some ten microseconds: a stream in the same process is not held up.
"""

import numpy as np

from .smoothers import SMOOTHERS, plane_weights

# status of an image point
OK = 0
OUTSIDE = 1
INVALID = 2
DIVIDED = 4  # added to the status of a cell that is divided
CELL_PX = (8, 4, 2)  # sizes of cells that are tried
LIMIT_PX = 0.01  # what the correction may differ from that of the exact model
# The difference is measured at middles; a kink between middle and corner has its own largest error
# beside them.
TARGET_PX = 0.6 * LIMIT_PX
FEW = 0.01  # share of cells that may be divided instead of having all of them smaller
# cells that are divided, and into how many parts along a side
MAX_DIVIDED = 2500
MAX_PARTS = 16
MAX_CHECKED = (
    25_000  # cells of the smallest size in which the difference is measured: those that bend most
)
MEMORY = 128_000_000  # bytes of the largest table
BLOCK = 200  # pixels of a block
PART = 2048  # pixels at which a model is evaluated at once: some milliseconds
CHUNK = 8192  # points that are looked up at once: what they need fits the cache
SPACES = (
    *range(0, 513, 32),
    1024,
    2048,
    4096,
    CHUNK,
)  # numbers of points for which there are arrays
EDGE = (
    1e-11  # part of a cell by which the image ends later, so that rounding leaves its edge on it
)


class CorrectionGrid:
    """Correction, standard deviation and status of the pixels of an image of image_size (width,
    height) from a table.

    model: the CorrectionModel. nodes: columns and rows [px] of the corners of cells; cell_px:
    longer side of a cell; divided: number of cells that are divided further. error_px: largest
    difference of a coordinate from the exact model in cells of the calibrated area, as measured at
    middles of cells and of their edges (beside them a kink may do half more, so it is kept well
    below LIMIT_PX); error_outside_px in the other cells; sd_error_px: that of the standard
    deviation, everywhere. The cells are as large as LIMIT_PX allows; if none are small enough, the
    errors say so. knn is piecewise constant, and has the smallest: its lookups lie between the
    values at the corners of the cell. A grid is not changed by its use: any number of threads may
    share it.
    """

    def __init__(self, model, image_size):
        self.image_size = tuple(int(s) for s in image_size)
        self.nodes, values, errors = _nodes_and_values(model, self.image_size)
        self.cell_px = float(max(np.diff(axis).max() for axis in self.nodes))
        outside = _outside(model, *self.nodes)
        rows, columns = self._shape = outside.shape
        # A frame of cells round the image says what is off it, with NaN and INVALID.
        table = _aligned((rows + 2, columns + 2, 12))
        table[:] = np.nan
        _coefficients(*self.nodes, values, table[1:-1, 1:-1])
        self._table = table.reshape(-1, 12)
        self._status = np.pad(
            np.where(outside, OUTSIDE, OK).astype(np.uint8), 1, constant_values=INVALID
        ).ravel()
        self._spaces = _no_spaces()
        self.divided = 0
        if model.kind != 'knn':
            self._divide(model, errors)
        self.error_px, self.error_outside_px = (
            float(np.nanmax(errors[0][part], initial=0.0)) for part in (~outside, outside)
        )
        self.sd_error_px = float(np.nanmax(errors[1]))

    def _divide(self, model, errors):
        """Divide the cells with the largest errors (2, h, w) [px], and put those that are left in
        their place.
        """
        bad = np.flatnonzero(errors[0] > TARGET_PX)
        bad = np.sort(bad[np.argsort(-errors[0].ravel()[bad], kind='stable')[:MAX_DIVIDED]])
        if not len(bad):
            return
        j, i = np.unravel_index(bad, self._shape)
        columns, rows = self.nodes
        # At a kink the error goes with the side of a cell; one more for what the middles have not
        # shown.
        need = 1 + np.ceil(np.log2(errors[0][j, i] / TARGET_PX))
        parts = np.minimum(2 ** need.astype(np.intp), MAX_PARTS)
        lines = [
            (
                np.linspace(columns[x], columns[x + 1], n + 1),
                np.linspace(rows[y], rows[y + 1], n + 1),
            )
            for x, y, n in zip(i, j, parts)
        ]
        values = np.split(
            _exact(model, np.concatenate([_pixels(*pair) for pair in lines])),
            np.cumsum((parts + 1) ** 2)[:-1],
            axis=1,
        )
        self._first = np.concatenate([[0], np.cumsum(parts**2)[:-1]])
        self._parts = parts
        self._parts_table = _aligned((int(np.sum(parts**2)), 12))
        for pair, n, start, of_cell in zip(lines, parts, self._first, values):
            _coefficients(
                *pair,
                of_cell.reshape(3, n + 1, n + 1),
                self._parts_table[start : start + n * n].reshape(n, n, 12),
            )
        self._divided_cells = (j + 1) * (self._shape[1] + 2) + i + 1
        self._status[self._divided_cells] += DIVIDED
        self.divided = len(bad)
        at = np.random.default_rng(0).random((2, 20, len(bad)))
        u, v = (
            axis[k] + part * (axis[k + 1] - axis[k])
            for axis, k, part in zip(self.nodes, (i, j), at)
        )
        found = self.look_up(u.ravel(), v.ravel())[0]
        left = (
            np.abs(found - _exact(model, np.stack([u.ravel(), v.ravel()], axis=1)))
            .reshape(3, *u.shape)
            .max(axis=1)
        )
        errors[:, j, i] = left[:2].max(axis=0), left[2]

    def __getstate__(self):
        # Copies of views would be arrays of their own.
        return {**self.__dict__, '_spaces': _no_spaces()}

    def look_up(self, u, v, values=None, status=None):
        """Values (3, n) du, dv and standard deviation [px], and status (n,), at columns u (n,) and
        rows v (n,) [px].

        Where the status is INVALID, which is off the image or not a number, the values are NaN.
        values (3, n) and status (n,) uint8: arrays to put the results into, for who looks up again
        and again.
        """
        n = len(u)
        if n <= CHUNK:
            return self._look_up(n, u, v, values, status)
        if values is None:
            values = np.empty((3, n))
            status = np.empty(n, dtype=np.uint8)
        for start in range(0, n, CHUNK):
            part = slice(start, start + CHUNK)
            self._look_up(min(CHUNK, n - start), u[part], v[part], values[:, part], status[part])
        return values, status

    def _look_up(self, n, u, v, values, status):
        """One chunk of n points. Few calls, between whole arrays of one shape: they are what 30
        points cost.
        """
        number = (n + 31) // 32 if n <= 512 else 16 + (n - 1 >> 9).bit_length()
        spaces = self._spaces[number]
        try:
            space = spaces.pop()  # whoever takes a space has it alone, and puts it back
        except IndexError:
            space = self._space(SPACES[number])
        (
            per_px,
            shift,
            low,
            high,
            stride,
            u3,
            v6,
            pair,
            place,
            cell,
            index,
            column,
            rows,
            rows_t,
            found,
            slopes,
            rest,
            half,
            of_u,
            of_1,
            result,
            state,
        ) = space
        u3[:, :n] = u
        v6[:, :n] = v
        np.multiply(pair, per_px, place)
        np.add(place, shift, place)
        np.fmax(place, low, place)  # of NaN, too
        np.fmin(place, high, place)
        cell[...] = place  # downwards: it is positive
        np.multiply(index, stride, index)
        np.add(index, column, index)
        self._table.take(index, 0, rows, 'clip')  # it is in range; other modes copy once more
        self._status.take(index, 0, state, 'clip')
        found[...] = rows_t
        np.multiply(slopes, v6, half)  # (rest + slopes v) of 1, and of u
        np.add(half, rest, half)
        np.multiply(of_u, u3, result)
        np.add(result, of_1, result)
        if self.divided:
            self._look_up_parts(pair, place, index, result, state)
        if values is None:
            values = result[:, :n].copy()
            status = state[:n].copy()
        else:
            values[...] = result[:, :n]
            status[...] = state[:n]
        spaces.append(space)
        return values, status

    def _look_up_parts(self, uv, place, index, result, state):
        """Put right what is in cells that are divided: result (3, n) and state (n,) at pixels uv
        (2, n), which are at place (2, n) in cells and have their cell's row index (n,).
        """
        which = np.flatnonzero(state >= DIVIDED)
        if not len(which):
            return
        cell = np.searchsorted(self._divided_cells, index[which])
        parts = self._parts[cell]
        place = place[:, which]
        column, row = np.minimum(((place - np.floor(place)) * parts).astype(np.intp), parts - 1)
        columns = self._parts_table[self._first[cell] + row * parts + column].T
        u, v = uv[:, which]
        half = columns[6:] * v + columns[:6]
        result[:, which] = half[3:] * u + half[:3]
        state[which] -= DIVIDED

    def _space(self, n):
        """Arrays and views of them for the lookup of n points."""
        rows, columns = self._shape
        number = np.array([columns, rows])
        per_px = (number - 2 * EDGE) / np.array(self.image_size)
        whole = np.ones((2, n))
        pixels = np.zeros((9, n))
        place = np.empty((2, n))
        cell = np.empty((2, n), dtype=np.intp)
        rows_of_table = np.empty((n, 12))
        found = np.empty((12, n))
        half = np.empty((6, n))
        return (
            whole * per_px[:, None],
            whole * (0.5 * per_px + 1 + EDGE)[:, None],
            whole * 0.5,
            whole * (number[:, None] + 1.5),
            np.full(n, columns + 2),
            pixels[:3],
            pixels[3:],
            pixels[2:4],
            place,
            cell,
            cell[1],
            cell[0],
            rows_of_table,
            rows_of_table.T,
            found,
            found[6:],
            found[:6],
            half,
            half[3:],
            half[:3],
            np.empty((3, n)),
            np.empty(n, dtype=np.uint8),
        )


def _aligned(shape):
    """An array of floats that begins with a line of the cache: rows lie in as few lines as they
    can.
    """
    size = int(np.prod(shape))
    memory = np.empty(size + 8)
    start = -memory.ctypes.data % 64 // 8
    return memory[start : start + size].reshape(shape)


def _no_spaces():
    """Lists, by SPACES, of the arrays for lookups that are not in use: as many as there are
    threads at a time.
    """
    return [[] for _ in SPACES]


# ---- how it is built


def _nodes_and_values(model, image_size):
    """Corners of the cells that are chosen, (columns (w,), rows (h,)) [px], the exact du, dv and
    standard deviations there (3, h, w), and the errors (2, h - 1, w - 1) [px] of correction and
    standard deviation in cells, NaN where they were not measured.
    """
    sizes = _sizes(model.kind, image_size)
    nodes = _nodes(image_size, sizes[0], 1)
    values = None
    for number, size in enumerate(sizes[:-1]):
        finer = _nodes(image_size, sizes[0], 2 ** (number + 1))
        finer_values = _exact_grid(model, *finer)
        values = finer_values[:, ::2, ::2]
        errors = _errors(finer_values)
        if np.mean(errors[0] > TARGET_PX) <= FEW:
            return nodes, values, errors
        nodes = finer
        values = finer_values
    values = _exact_grid(model, *nodes) if values is None else values
    return nodes, values, _errors_where_it_bends(model, *nodes, values)


def _sizes(kind, image_size):
    """Sizes of cells [px] to try, each half the one before."""
    area = image_size[0] * image_size[1]
    bytes_of_cell = 12 * 8
    sizes = [size for size in CELL_PX if area / size**2 * bytes_of_cell <= MEMORY]
    if not sizes:
        return [2 ** np.ceil(np.log2(area * bytes_of_cell / MEMORY) / 2)]
    if kind == 'knn':
        return sizes[-1:]  # it has steps, of which smaller cells blur less
    return (
        sizes[-2:] if kind in SMOOTHERS else sizes
    )  # smoothers have kinks: no larger ones would do


def _nodes(image_size, size, parts):
    """Corners (columns (w,), rows (h,)) [px] of cells, from edge to edge: 1/parts of cells of at
    most size [px].
    """
    return tuple(
        np.linspace(-0.5, s - 0.5, parts * max(1, int(np.ceil(s / size))) + 1) for s in image_size
    )


def _pixels(columns, rows):
    """Pixels (h * w, 2), row by row."""
    return np.stack([np.tile(columns, len(rows)), np.repeat(rows, len(columns))], axis=1)


def _exact_grid(model, columns, rows):
    """The model's du, dv and standard deviations (3, h, w) [px] at columns (w,) and rows (h,)
    [px].
    """
    return _exact(model, _pixels(columns, rows)).reshape(3, len(rows), len(columns))


def _exact(model, uv):
    """The model's du, dv and standard deviations (3, n) [px] at pixels uv (n, 2)."""
    out = np.zeros((3, len(uv)))
    norm2 = np.zeros(len(uv))
    if model.kind in SMOOTHERS:
        _smooth(model, uv, out, norm2)
    for start in range(0, len(uv), PART):
        part = slice(start, start + PART)
        if model.kind != 'none':
            out[:2, part] += model.global_part(uv[part]).T
        out[2, part] = model.sd(norm2[part], uv[part])
    return out


def _smooth(model, uv, duv, norm2):
    """Put the smoother's part of the correction at pixels uv (n, 2) into duv (2 or more, n) [px],
    and the squared norms of its weights into norm2 (n,).
    """
    pieces = _pieces(uv)
    for start in range(0, len(pieces), 32):
        some = pieces[start : start + 32]
        low, high = (
            np.array([end(uv[piece], axis=0) for piece in some]) for end in (np.min, np.max)
        )
        middle = (low + high) / 2
        diagonal = np.linalg.norm(high - low, axis=1)
        kth = model.tree.query(middle, k=[model.k])[0][:, 0]
        for piece, near in zip(
            some, model.tree.query_ball_point(middle, (kth + diagonal) * (1 + 1e-9) + 1e-9)
        ):
            weights = _weights(model, model.train_uv[near], uv[piece])
            for c, left in enumerate(model.left[near].T):
                duv[c, piece] = np.einsum('nk,k->n', weights, left)
            norm2[piece] = np.einsum('nk,nk->n', weights, weights)


def _pieces(uv):
    """Rows of pixels (n, 2) that lie together, some BLOCK of them each."""
    low = uv.min(axis=0)
    high = uv.max(axis=0)
    # Not larger than 64 px, for pixels that lie here and there.
    side = min(64.0, np.sqrt(BLOCK * np.prod(high - low + 1) / len(uv)))
    column, row = ((uv - low) / side).astype(np.intp).T
    block = row * (column.max() + 1) + column
    order = np.argsort(block, kind='stable')
    border = np.flatnonzero(np.diff(block[order])) + 1
    return [
        part[i : i + 2 * BLOCK]
        for part in np.split(order, border)
        for i in range(0, len(part), 2 * BLOCK)
    ]


def _weights(model, near, uv):
    """Weights (n, c) of training pixels near (c, 2) in the smoother's predictions at pixels uv (n,
    2): zero but for the k nearest.
    """
    dx = near[:, 0] - uv[:, :1]
    dy = near[:, 1] - uv[:, 1:]
    square = dx * dx
    square += dy * dy
    kth = np.partition(square, model.k - 1, axis=1)[:, model.k - 1]
    if model.kind == 'knn':
        chosen = (square <= kth[:, None]).astype(float)
        return chosen / chosen.sum(
            axis=1, keepdims=True
        )  # equally distant ones share the last place
    ratio = square / np.maximum(kth, 1e-12)[:, None]
    np.minimum(ratio, 1, out=ratio)
    kernel = np.sqrt(ratio)
    kernel *= ratio
    np.subtract(1, kernel, out=kernel)
    kernel *= kernel * kernel
    alike = np.einsum('nk->n', kernel) <= 1e-9  # all neighbours at one distance: they count alike
    if alike.any():
        kernel[alike] = square[alike] <= kth[alike, None]
    return plane_weights(dx, dy, kernel, kth)


def _errors(values):
    """Errors (2, h, w) [px] of correction and standard deviation in cells of which values (3, 2h +
    1, 2w + 1) has corners, middles of the edges, and middles.
    """
    corner = values[:, ::2, ::2]
    along_u = (corner[:, :, :-1] + corner[:, :, 1:]) / 2
    along_v = (corner[:, :-1] + corner[:, 1:]) / 2
    of_u = np.abs(values[:, ::2, 1::2] - along_u)
    of_v = np.abs(values[:, 1::2, ::2] - along_v)
    error = np.abs(values[:, 1::2, 1::2] - (along_u[:, :-1] + along_u[:, 1:]) / 2)
    for other in (of_u[:, :-1], of_u[:, 1:], of_v[:, :, :-1], of_v[:, :, 1:]):
        np.maximum(error, other, out=error)
    return np.stack([error[:2].max(axis=0), error[2]])


def _errors_where_it_bends(model, columns, rows, values):
    """The same for cells with corners at columns (w,) and rows (h,) [px] and values (3, h, w)
    there, measured where it may be too large by the second differences, and in at least 500 cells;
    elsewhere NaN.
    """
    bend = np.zeros(values.shape[1:])
    bend[:, 1:-1] = np.abs(np.diff(values[:2], 2, axis=2)).max(axis=0)
    bend[1:-1] += np.abs(np.diff(values[:2], 2, axis=1)).max(axis=0)
    bend = np.maximum(bend[:-1], bend[1:])
    bend = np.maximum(bend[:, :-1], bend[:, 1:])
    # At a kink the error is half the second difference at most, where else it bends an eighth.
    count = (
        500
        if model.kind == 'knn'
        else np.clip(np.count_nonzero(bend > 1.5 * TARGET_PX), 500, MAX_CHECKED)
    )
    j, i = np.unravel_index(np.argsort(-bend, axis=None)[:count], bend.shape)
    errors = np.full((2, *bend.shape), np.nan)
    errors[:, j, i] = 0.0
    for x, y in ((0.5, 0.5), (0.5, 0.0), (0.0, 0.5), (0.5, 1.0), (1.0, 0.5)):
        uv = np.stack(
            [
                columns[i] + x * (columns[i + 1] - columns[i]),
                rows[j] + y * (rows[j + 1] - rows[j]),
            ],
            axis=1,
        )
        found = (1 - y) * ((1 - x) * values[:, j, i] + x * values[:, j, i + 1]) + y * (
            (1 - x) * values[:, j + 1, i] + x * values[:, j + 1, i + 1]
        )
        error = np.abs(found - _exact(model, uv))
        errors[:, j, i] = np.maximum(errors[:, j, i], [error[:2].max(axis=0), error[2]])
    return errors


def _outside(model, columns, rows):
    """True (h - 1, w - 1) for cells with a corner beyond the calibrated area: what is not is
    wholly inside, as the area is convex.
    """
    step = max(1, PART // len(columns))
    node = np.concatenate(
        [model.outside(_pixels(columns, rows[i : i + step])) for i in range(0, len(rows), step)]
    )
    node = node.reshape(len(rows), len(columns))
    return node[:-1, :-1] | node[:-1, 1:] | node[1:, :-1] | node[1:, 1:]


def _coefficients(columns, rows, values, out):
    """Put the coefficients of cells into out (h - 1, w - 1, 12): of 1, u, v and u v, each for du,
    dv and the standard deviation, with corners at columns (w,) and rows (h,) [px] and values (3,
    h, w) there.
    """
    x = columns[:-1]
    y = rows[:-1, None]
    wide = np.diff(columns)
    high = np.diff(rows)[:, None]
    corner = values[:, :-1, :-1]
    of_x = (values[:, :-1, 1:] - corner) / wide
    of_y = (values[:, 1:, :-1] - corner) / high
    of_xy = ((values[:, 1:, 1:] - values[:, 1:, :-1]) / wide - of_x) / high
    for k in range(3):
        a = corner[k]
        b = of_x[k]
        c = of_y[k]
        d = of_xy[k]
        out[:, :, k] = a - b * x - (c - d * x) * y
        out[:, :, 3 + k] = b - d * y
        out[:, :, 6 + k] = c - d * x
        out[:, :, 9 + k] = d


__all__ = ['INVALID', 'LIMIT_PX', 'OK', 'OUTSIDE', 'CorrectionGrid']
