# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Parts of the detection of beads: noise of responses, places in reduced images, large beads."""

from dataclasses import replace
from types import SimpleNamespace as Fake

import cv2
import numpy as np
import pytest
from scipy.signal import convolve2d

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.findings import Finding, Kind
from fluoro_calib_ros.images import contrasts, detection, extraction
from fluoro_calib_ros.images.clipping import Clipping
from fluoro_calib_ros.images.detection import (
    _background,
    _Blobs,
    _blobs,
    _inside,
    _noise_of_response,
    _resolutions,
    _Sight,
    _typical,
    vertex,
)
from fluoro_calib_ros.images.light import LAGS, Light, Noise
from fluoro_calib_ros.images.marker_intensity import check_image
from fluoro_calib_ros.images.markers import FirstMarkers, MarkerTracker
from fluoro_calib_ros.images.profile import Profile

RNG = np.random.default_rng(51)
WHITE = np.zeros((2 * LAGS + 1, 2 * LAGS + 1))
WHITE[LAGS, LAGS] = 1.0


def second_derivative(image, scale):
    smooth = cv2.GaussianBlur(image, (0, 0), scale)
    return scale**2 * (smooth[:, 2:] - 2 * smooth[:, 1:-1] + smooth[:, :-2])


@pytest.mark.parametrize('scale', [1.5, 4.0])
@pytest.mark.parametrize('across', [False, True])
def test_noise_of_a_response_is_that_of_filtered_noise(scale, across):
    """The noise is correlated along or across the rows; the derivative is along the rows."""
    white = RNG.normal(size=(700, 700)).astype(np.float32)
    kernel = np.array([0.2, 0.6, 0.2])
    kernel = kernel[:, None] if across else kernel[None]
    for noise, one in ((white, np.ones((1, 1))), (convolve2d(white, kernel, 'same'), kernel)):
        own = convolve2d(one, one[::-1, ::-1])
        correlation = WHITE * 0
        h, w = own.shape
        rows, columns = (slice(LAGS - n // 2, LAGS + n // 2 + 1) for n in (h, w))
        correlation[rows, columns] = own / own.max()
        sd = second_derivative(noise.astype(np.float32), scale)[40:-40, 40:-40].std()
        expected = sd / noise[40:-40, 40:-40].std()
        found = _noise_of_response(Noise(1.0, 0.0, correlation), scale)
        assert found == pytest.approx(expected, rel=0.06)


def test_background_of_a_plane_is_the_plane():
    v, u = np.mgrid[:240, :320].astype(np.float32)
    plane = 500 + 0.5 * u - 0.3 * v
    for scale in (1.1, 3.0):
        found = _background(plane, scale)
        inner = np.s_[70:-70, 70:-70]
        np.testing.assert_allclose(found[inner], plane[inner], atol=0.5)
        assert _background(3 * plane, scale)[inner] == pytest.approx(3 * found[inner], rel=1e-5)
    spot = np.zeros((401, 401), np.float32)
    spot[200, 200] = 1e6
    seen = _background(spot, 2.0)
    expected = 1e6 * np.exp(-0.5 * (np.arange(-200, 201) / 16.0) ** 2) / (2 * np.pi * 16.0**2)
    np.testing.assert_allclose(seen[200, 140:261], expected[140:261], atol=0.05 * expected.max())


def test_images_are_reduced_so_that_scales_are_told_apart():
    grey = RNG.uniform(0, 100, (260, 300)).astype(np.float32)
    for (scale, part, factor), expected in zip(_resolutions(grey), detection.SCALES):
        assert scale == expected
        assert scale / factor < detection.FINE_SCALE or min(part.shape) <= 64
        assert scale / factor > 1.0 and part.shape == (260 // factor, 300 // factor)
        height, width = (factor * n for n in part.shape)
        blocks = grey[:height, :width].reshape(part.shape[0], factor, part.shape[1], factor)
        np.testing.assert_allclose(part, blocks.mean(axis=(1, 3)), rtol=1e-3)
    small = RNG.uniform(0, 100, (40, 300)).astype(np.float32)
    assert {factor for *_, factor in _resolutions(small)} == {1}


def test_places_in_a_reduced_image_are_those_of_the_whole():
    """The centre of a pixel of a reduced image lies between the centres of its pixels."""
    fine = 4
    v, u = (np.mgrid[: fine * 160, : fine * 200] + 0.5) / fine - 0.5
    centre = np.array([90.4, 70.7])
    image = 1000 - 400 * np.exp(-0.5 * ((u - centre[0]) ** 2 + (v - centre[1]) ** 2) / 6.0**2)
    image = image.reshape(160, fine, 200, fine).mean(axis=(1, 3)).astype(np.float32)
    for factor in (1, 2, 4):
        part = cv2.resize(image, (200 // factor, 160 // factor), interpolation=cv2.INTER_AREA)
        dark, _ = _blobs(part, Noise(1.0, 0.0, WHITE), 6.0 / factor, factor)
        strongest = dark.uv[np.argmax(dark.response)]
        np.testing.assert_allclose(strongest, centre, atol=0.15)
        # The response is a quarter of the height, as the filter is as wide as the blob.
        best = np.argmax(dark.response)
        assert dark.response[best] == pytest.approx(400 / 4, rel=0.15)
        assert dark.relative[best] == pytest.approx(100 / 960, rel=0.18)
        turned = _blobs(part.max() - part, Noise(1.0, 0.0, WHITE), 6.0 / factor, factor)
        _, other = turned
        np.testing.assert_allclose(other.uv[np.argmax(other.response)], centre, atol=0.15)


def test_a_pixel_is_in_the_field_by_its_middle():
    field = np.zeros((4, 5), bool)
    field[1, 2] = True
    uv = np.array([[2.4, 1.4], [2.6, 1.4], [2.4, 1.6], [1.6, 0.6]])
    assert _inside(uv, field).tolist() == [True, False, False, True]
    # The field covers columns 4 and 5 and rows 2 and 3 of the whole image.
    uv = np.array([[3.6, 1.6], [5.4, 3.4], [3.4, 2.0], [5.0, 3.6]])
    assert _inside(uv, field, 2).tolist() == [True, True, False, False]


def test_typical_value_is_the_median_of_the_largest():
    values = np.array([1.0, 9, 2, 8, 7, 3])
    assert _typical(values, 3) == 8.0 and _typical(values, 4) == 7.5 and _typical(values, 7) == 0
    assert _typical(values, 6) == 5.0


def test_vertex_is_that_of_the_parabola():
    x = np.array([-0.4, 0.0, 0.3])
    samples = [5 - 2 * (at - x) ** 2 for at in (-1, 0, 1)]
    np.testing.assert_allclose(vertex(*samples), x)
    assert vertex(np.array([1.0]), np.array([1.0]), np.array([1.0])).tolist() == [0]
    assert vertex(np.array([0.0]), np.array([0.1]), np.array([9.0])).tolist() == [0]  # no maximum
    assert vertex(np.array([0.0]), np.array([1.0]), np.array([1.9])).tolist() == [0.5]


def test_several_maxima_in_a_larger_blob_are_one(monkeypatch):
    """They are merged only if there are several and the larger blob responds more strongly."""
    uv = np.array([[50.0, 50], [56, 50], [100, 100], [180, 60]])
    blobs = _Blobs(uv, np.full(4, 9.0), np.array([0.3, 0.4, 0.3, 0.2]))
    sight = _Sight(np.zeros((200, 240), np.float32), None, 4)

    def merged(relative):
        wide = _Blobs(np.array([[53.0, 50.0], [100.5, 100.0]]), np.zeros(2), np.array(relative))
        none = _Blobs(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
        asked = []

        def found(part, noise, scale, factor, polarities):
            assert polarities == (False,)
            asked.append((part.shape, scale, factor))
            return [wide if len(asked) == 1 else none]

        monkeypatch.setattr(detection, '_blobs', found)
        out = sight.merged(blobs, 3.0, False)
        # 4.2, 6 and 8.4 px, each searched in an image in which the scale is 2.9 px or more.
        assert [factor for _, _, factor in asked] == [1, 2, 2]
        assert [scale * factor for _, scale, factor in asked] == pytest.approx([4.2, 6.0, 8.4])
        assert asked[1][0] == (100, 120)
        return out.tolist()

    assert merged([0.41, 0.9]) == [[100, 100], [180, 60], [53, 50]]
    assert merged([0.4, 0.9]) == uv.tolist()
    alone = blobs.chosen(np.array([True, False, True, True]))
    assert sight.merged(alone, 0.5, False).tolist() == alone.uv.tolist()


# ---- extraction


def test_usual_depth_is_linear_in_the_light_without_the_odd_ones():
    """Contrast is depth times light: a share of the direct light, plus what a sheet adds."""
    light = RNG.uniform(500, 2000, 60)
    relative = light / np.median(light)
    depth = (0.8 * relative + 0.15) / relative
    depth[:6] = [2.0, 0.2, 1.9, 0.1, 2.5, 0.3]
    measured = np.ones(60, bool)
    measured[50] = False
    light[51] = 0.0
    beads = Fake(uv=np.zeros((60, 2)), light=light, depth=depth, measured=measured)
    found = contrasts.usual_depth(beads)
    good = np.delete(np.arange(60), [50, 51])
    np.testing.assert_allclose(found[good], 0.8 + 0.15 / relative[good], rtol=0.02)
    assert found[[50, 51]].tolist() == [1, 1]
    few = Fake(**{k: v[:3] for k, v in vars(beads).items()})
    assert contrasts.usual_depth(few).tolist() == [1, 1, 1]


def contrasting(black, light, noise=0.0):
    """Return beads in light over `black`, which absorb 80 % of it, with errors of contrasts."""
    n = len(light)
    error = np.zeros(n) + noise
    depth = (0.8 * (light - black) + error * np.median(light)) / light
    uv = np.stack(np.meshgrid(np.arange(8.0), np.arange(n // 8)), -1).reshape(-1, 2)
    return Fake(uv=uv, light=light, depth=depth, measured=np.ones(n, bool), misfit=np.ones(n))


@pytest.mark.parametrize('black', [-60.0, 30.0])
def test_contrasts_tell_the_grey_value_of_no_light(black):
    light = np.linspace(60.0, 180.0, 64)
    random = RNG.normal(0, 0.01, 64)
    assert contrasts.black_level(contrasting(black, light, random), 0.0) == pytest.approx(
        black, abs=8
    )
    # It stays where contrasts scatter more, as slowly as the light, or hardly tell it.
    assert contrasts.black_level(contrasting(black, light, 20 * random), 0.0) == 0.0
    slow = 0.1 * np.sin(np.arange(64) / 8)
    assert contrasts.black_level(contrasting(0.0, light, slow), 0.0) == 0.0
    assert contrasts.black_level(contrasting(-5.0, light, random), 0.0) == 0.0
    assert contrasts.black_level(contrasting(0.0, 150 + 0.01 * light, random), 7.0) == 7.0
    few = Fake(**{name: value[:16] for name, value in vars(contrasting(-60.0, light)).items()})
    assert contrasts.black_level(few, 0.0) == 0.0


def test_hidden_light_shows_no_larger_grey_value_of_no_light():
    """Only the dark inside of shadows is seen: an error of the light is one of the contrast."""
    seen = np.linspace(60.0, 180.0, 64)
    hidden = np.linspace(280.0, 420.0, 64)
    dark = contrasting(0.0, hidden)
    dark.depth = 1 - 60.0 / hidden
    assert contrasts.black_level(dark, 0.0) == pytest.approx(60.0)
    assert contrasts.black_level(dark, 0.0, Clipping(high=255.0)) == 0.0
    # The opposite is no such error.
    below = contrasting(-60.0, hidden)
    assert contrasts.black_level(below, 0.0, Clipping(high=255.0)) == pytest.approx(-60.0, abs=1)
    half = contrasting(30.0, np.where(np.arange(64) % 2, seen, hidden))
    half.depth[::2] = 1 - 60.0 / hidden[::2]
    assert contrasts.black_level(half, 0.0, Clipping(high=255.0)) == pytest.approx(30.0, abs=1)


def test_grey_value_of_no_light_is_at_most_twice_the_light_below_zero():
    """The contrast of a logarithmic image is the same everywhere."""
    light = np.linspace(60.0, 180.0, 64)
    same = contrasting(0.0, light)
    same.depth = 40.0 / light
    assert contrasts.black_level(same, 0.0) == pytest.approx(-240)
    # Light above -240, whose median is 360; the contrasts are still the same.
    same.light = light + 240
    same.depth = 40.0 / same.light
    assert contrasts.black_level(same, -240.0) == -240


def test_light_over_a_grey_value_has_the_same_noise_and_the_same_shadow():
    noise = Noise(4.0, 0.5, np.ones((1, 1)))
    grey = np.array([[20.0, 80.0, 255.0]], dtype=np.float32)
    light = Light(grey, np.ones((1, 3), bool), Clipping(20.0, 255.0))
    above = light.above(-50.0)
    assert above.grey.tolist() == [[70, 130, 305]]
    assert (above.clipping.low, above.clipping.high) == (70, 305)
    assert light.above(0.0) is light
    np.testing.assert_allclose(noise.above(-50.0).variance(above.grey), noise.variance(grey))
    profile = Profile(6.0, 1.2, 0.9, 0.1)
    wide = replace(profile, blur_px=0.01), profile.in_light(1.5)
    middle = [one.absorbed(np.zeros(1))[0] for one in wide]
    assert middle[1] == pytest.approx(0.9 * middle[0] / 1.5)


@pytest.mark.parametrize(
    ('fitted_px', 'outcome', 'expected'),
    [(5.1, 'pose', None), (5.3, 'pose', 'anew'), (1.2, 'pose', 'anew'), (5.3, 'none', None),
     (5.3, 'refused', None)],
)  # fmt: skip
def test_beads_are_detected_anew_by_their_fitted_size(monkeypatch, fitted_px, outcome, expected):
    looks = []

    def detect(image, count, look):
        looks.append(look)
        if outcome == 'refused':
            raise DataError('no beads')
        return 'detections'

    monkeypatch.setattr(extraction, 'detect_beads', detect)
    monkeypatch.setattr(extraction, '_seen', lambda detections, model: 'seen')
    matched = None if outcome == 'none' else 'match'
    monkeypatch.setattr(extraction, 'follow', lambda *given: matched)
    monkeypatch.setattr(extraction, '_measured', lambda *given: 'anew')
    first = Fake(
        detections=Fake(radius_px=2.6, inverted=True),
        imaging=Fake(profile=Fake(radius_px=fitted_px)),
        nearby=Fake(view=Fake(lens=Fake(image_size=(4, 3))), scale_px=0.1, far=None),
    )
    assert (
        extraction._detected_anew(np.zeros((3, 4)), first, Fake(xyz=np.zeros((36, 3)))) == expected
    )
    assert [(look.radius_px, look.inverted) for look in looks] == (
        [] if fitted_px == 5.1 else [(fitted_px, True)]
    )


def found_with(bead, refused=()):
    n = len(bead)
    return extraction.Extraction(
        np.array(bead), np.arange(2.0 * n).reshape(n, 2), np.arange(n) / 10, np.zeros(n, bool),
        tuple(refused), None, None, None, None,
    )  # fmt: skip


@pytest.mark.parametrize(('kind', 'is_kept'), [('vague', True), ('other', False)])
def test_a_bead_without_neighbours_is_refused_unless_they_are_vague(kind, is_kept):
    xyz = np.array([[float(i), 0, 0] for i in range(9)] + [[100.0 + i, 0, 0] for i in range(9)])
    kinds = {'vague': next(iter(extraction.VAGUE)), 'other': Kind.BEAD_AWAY}
    assert Kind.BEAD_AWAY not in extraction.VAGUE
    alone = 13
    refused = [
        extraction.Refusal(row, np.zeros(2), Finding(kinds[kind], 'x'))
        for row in range(9, 18)
        if row != alone
    ]
    given = found_with([*range(9), alone], refused)
    found = extraction._with_support(given, Fake(xyz=xyz), np.arange(18))
    assert found.bead.tolist() == [*range(9), *([alone] if is_kept else [])]
    assert len(found.uv) == len(found.sigma) == len(found.overlapped) == len(found.bead)
    if is_kept:
        assert found is given
    else:
        (last,) = found.refused[len(refused) :]
        assert last.bead == alone and last.uv.tolist() == [18, 19]
        assert last.finding is extraction.ALONE


def test_looks_are_tried_in_their_order_until_a_pose_is_sure(monkeypatch):
    """The reason given is that of the likeliest look; an ambiguous pose ends the search."""

    def searched(outcomes):
        tried = []
        monkeypatch.setattr(
            extraction, 'likely_detections', lambda image, beads: iter(range(len(outcomes)))
        )
        monkeypatch.setattr(extraction, '_seen', lambda detections, model: detections)

        def match(seen, model, lens):
            tried.append(seen)
            if isinstance(outcomes[seen], DataError):
                raise outcomes[seen]
            return outcomes[seen]

        monkeypatch.setattr(extraction, 'match', match)
        monkeypatch.setattr(extraction, '_measured', lambda *given: given[:3])
        monkeypatch.setattr(extraction, '_detected_anew', lambda *given: None)
        try:
            return extraction._searched(None, Fake(xyz=np.zeros((4, 3))), None), tried
        except DataError as error:
            return error, tried

    none = DataError('none', kind=Kind.NO_POSE)
    later = DataError('later', kind=Kind.POSE_UNSURE)
    ambiguous = DataError('ambiguous', kind=Kind.POSE_AMBIGUOUS)
    assert searched([none, 'pose', 'other']) == ((1, 1, 'pose'), [0, 1])
    assert searched([none, later, later]) == (none, [0, 1, 2])
    assert searched([later, ambiguous, 'pose']) == (later, [0, 1])
    assert searched([ambiguous, 'pose']) == (ambiguous, [0])


@pytest.mark.parametrize(('size', 'is_refused'), [(31, True), (32, False)])
def test_an_image_has_32_pixels_at_least(size, is_refused):
    image = np.zeros((size, 90), np.uint8)
    image[3, 4] = 9
    for given in (image, image.T):
        if is_refused:
            with pytest.raises(DataError, match=f'only {given.shape[1]} x {given.shape[0]} px'):
                detection._check(given)
        else:
            detection._check(given)
            check_image(given)
    for wrong in (np.zeros((40, 40, 3), np.uint8), np.zeros((40, 40), float)):
        with pytest.raises(DataError):
            detection._check(wrong)
    with pytest.raises(DataError, match='every pixel has the grey value 7'):
        detection._check(np.full((40, 40), 7, np.uint8))


def discs(rng, light, contrast, size=512):
    """Image of twelve by twelve discs with a radius of 5 px; their contrast is grey values."""
    uv = np.stack(np.meshgrid(*[np.linspace(40, size - 40, 12)] * 2), -1).reshape(-1, 2)
    uv = uv + rng.uniform(-4, 4, uv.shape)
    v, u = np.mgrid[:size, :size]
    grey = np.zeros((size, size))
    for x, y in uv:
        near = np.s_[round(y) - 6 : round(y) + 7, round(x) - 6 : round(x) + 7]
        grey[near] = np.maximum(grey[near], np.hypot(u[near] - x, v[near] - y) < 5)
    grey = light + contrast * cv2.GaussianBlur(grey, (0, 0), 1.2)
    return np.clip(grey + rng.normal(0, 15, grey.shape), 0, 4095).astype(np.uint16), uv


@pytest.mark.parametrize('text', [np.s_[100:101, 5:6], np.s_[3:15, 5:60]])
@pytest.mark.parametrize(('light', 'contrast'), [(1000, 1500), (2500, -1500)])
def test_a_hot_pixel_or_a_text_of_full_scale_hides_no_bead(light, contrast, text):
    image, uv = discs(np.random.default_rng(3), light, contrast)
    image[text] = 65535
    found = next(detection.likely_detections(image, len(uv)))
    assert found.inverted == (contrast > 0)
    away = np.linalg.norm(found.uv[:, None] - uv, axis=2).min(axis=0)
    assert (away < 1).all() and len(found.uv) <= len(uv) + 3


@pytest.mark.parametrize('bits', [8, 12])
def test_bright_markers_are_measured_in_images_of_any_bit_depth(bits):
    image, uv = discs(np.random.default_rng(4), 1000, 1500)
    if bits == 8:
        image = (image // 16).astype(np.uint8)
    ids = np.arange(len(uv))
    frame = MarkerTracker(first=FirstMarkers(ids, uv)).update(image, 1)
    assert len(frame.target_id) == len(uv)
    assert np.abs(frame.uv - uv[frame.target_id]).max() < 0.4  # discs have whole pixels


@pytest.mark.parametrize('beads', [130, 500])
def test_an_image_without_light_in_its_middle_is_refused_or_has_no_beads(beads):
    shut = np.zeros((512, 512), np.uint8)
    shut[20:30, 20:100] = 200  # a text on a closed collimator
    assert len(next(detection.likely_detections(shut, beads)).uv) < 10
    overexposed = np.full((512, 512), 255, np.uint8)
    overexposed[:100] = np.random.default_rng(5).normal(150, 3, (100, 512))
    with pytest.raises(DataError, match='saturated'):
        next(detection.likely_detections(overexposed, beads))
