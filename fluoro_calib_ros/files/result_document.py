"""The result of a job as the document result.json (DESIGN, section 6)."""

import numpy as np

from ..photogrammetry.rotations import quaternion_from_matrix


def result_document(job):
    """Dict of a CalibrationResult: lengths in mm, pixels in px, angles in rad, each with the unit in its
    name.
    """
    return {
        'fluoroscopes': {
            name: _fluoroscope(figures) for name, figures in job.fluoroscopes.items()
        },
        'targets': [
            {'target_id': int(i), 'xyz_mm': xyz, 'sd_mm': sd}
            for i, xyz, sd in zip(
                job.targets.target_id,
                job.targets.xyz_mm,
                np.sqrt(np.diagonal(job.targets.covariance, axis1=1, axis2=2)),
            )
        ],
        'relative_orientation': _relative(job.relative),
        'outliers': {'image_points': list(job.outliers[0]), 'targets': list(job.outliers[1])},
        'correlations': [
            {'unknowns': [one, other], 'value': value} for one, other, value in job.correlations
        ],
        'history': _history(job.history),
        'converged': job.converged,
        'left_out': list(job.left_out),
        'seconds': job.seconds,
    }


def _relative(orientations):
    """The relative orientation of two fluoroscopes, a list where there are more, None where there
    is none.
    """
    out = [
        {
            'fluoroscopes': list(o.fluoroscopes),
            'quaternion_wxyz': quaternion_from_matrix(o.pose.rotation),
            'translation_mm': o.pose.translation_mm,
            'sd_mm': o.sd_mm,
            'sd_rad': o.sd_rad,
            'scatter_mm': o.scatter_mm,
            'scatter_rad': o.scatter_rad,
            'exposures': o.exposures,
            'constraint': o.constraint,
        }
        for o in orientations
    ]
    return out if len(out) > 1 else (out[0] if out else None)


def _fluoroscope(figures):
    xp, yp, c = figures.interior
    return {
        'interior': {'xp': xp, 'yp': yp, 'c': c, 'sd': figures.interior_sd},
        'image_size': list(figures.image_size),
        'model': {'kind': figures.model_kind, 'k': figures.k},
        'rmse_px': {'before': figures.rmse_before, 'after': figures.rmse_after},
        'inliers': figures.inliers,
        'observations': figures.observations,
        'exposures': [
            {
                'exposure': e.exposure,
                'position_mm': e.position_mm,
                'quaternion_wxyz': e.quaternion_wxyz,
                'sd_mm': e.sd_mm,
                'sd_rad': e.sd_rad,
            }
            for e in figures.exposures
        ],
    }


def _history(history):
    """Rounds in order, those of fluoroscopes that were calibrated one after the other likewise."""
    return [
        {
            'fluoroscopes': label.split('+'),
            'iteration': r.iteration,
            'F': r.F,
            'G': r.G,
            'k': r.k,
            'rmse_px': r.rmse,
            'change_px': r.change,
        }
        for label, rounds in history.items()
        for r in rounds
    ]
