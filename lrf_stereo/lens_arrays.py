"""The two distortion models over tiles of cameras x points, with derivatives.

Terms are up to four arrays (c, 1), one value for each camera; coordinates are (c, n). The formulas are those of
`network_calib.cameras`; here each kind of lens has its own functions, so that a tile never computes both.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from network_calib.observations import FloatArray

Slope = tuple[FloatArray, FloatArray, FloatArray]


class Brown:
    """Radial-tangential distortion k1, k2, p1, p2; the last two may be left out where they are zero."""

    @staticmethod
    def needed(terms: FloatArray) -> FloatArray:
        """The terms without p1, p2 where no camera has them."""
        return terms if terms[2:].any() else terms[:2]

    @staticmethod
    def is_bent(terms: FloatArray) -> bool:
        """Whether the image is not the same all around the axis."""
        return len(terms) == 4

    @staticmethod
    def distorted(terms: FloatArray, u: FloatArray, v: FloatArray, r2: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distorted coordinates of x/z, y/z, with r2 = u^2 + v^2."""
        k1, k2 = terms[:2]
        radial = k2 * r2
        radial += k1
        radial *= r2
        radial += 1
        ud, vd = u * radial, v * radial
        if len(terms) == 4:
            p1, p2 = terms[2:]
            cross = 2 * u * v
            ud += p1 * cross + p2 * (r2 + 2 * u * u)
            vd += p1 * (r2 + 2 * v * v) + p2 * cross
        return ud, vd

    @staticmethod
    def slope(terms: FloatArray, u: FloatArray, v: FloatArray, r2: FloatArray) -> Slope:
        """Entries 00, 01 (= 10), 11 of the derivative of the distorted by the undistorted coordinates."""
        k1, k2 = terms[:2]
        grow = 2 * k1 + (4 * k2) * r2
        radial = 1 + r2 * (k1 + k2 * r2)
        grow_u = grow * u
        a00, a01, a11 = radial + grow_u * u, grow_u * v, radial + grow * v * v
        if len(terms) == 4:
            p1, p2 = terms[2:]
            p1u, p1v, p2u, p2v = p1 * u, p1 * v, p2 * u, p2 * v
            a00 += 2 * p1v + 6 * p2u
            a01 += 2 * (p1u + p2v)
            a11 += 6 * p1v + 2 * p2u
        return a00, a01, a11

    @staticmethod
    def by_terms(u: FloatArray, v: FloatArray, r2: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Derivatives of the distorted coordinates by each of the four terms."""
        ur2, vr2 = u * r2, v * r2
        yield ur2, vr2
        yield ur2 * r2, vr2 * r2
        cross = 2 * u * v
        yield cross, r2 + 2 * v * v
        yield r2 + 2 * u * u, cross

    @staticmethod
    def fold_r2(terms: FloatArray) -> FloatArray:
        """(c,) squared radius at which the image folds back; infinite where it never does.

        1 + 3 k1 s + 5 k2 s^2 = 0 at the smallest s > 0, that is x^2 + 3 k1 x + 5 k2 = 0 at the largest x = 1/s.
        """
        half, last = 1.5 * terms[0].ravel(), 5 * terms[1].ravel()
        discriminant = half * half - last
        largest = np.sqrt(np.maximum(discriminant, 0.0)) - half
        folds = (discriminant >= 0) & (largest > 0)
        return np.where(folds, 1 / np.where(folds, largest, 1.0), np.inf)


class KannalaBrandt:
    """Fisheye distortion k1..k4: the radius is theta (1 + k1 theta^2 + ... + k4 theta^8)."""

    @staticmethod
    def needed(terms: FloatArray) -> FloatArray:
        """All terms."""
        return terms

    @staticmethod
    def is_bent(terms: FloatArray) -> bool:
        """Never: only the radius is distorted."""
        del terms
        return False

    @staticmethod
    def distorted(terms: FloatArray, u: FloatArray, v: FloatArray, r2: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distorted coordinates of x/z, y/z, with r2 = u^2 + v^2."""
        k1, k2, k3, k4 = terms
        # The square keeps r above 1e-140, where theta / r is exactly one, and leaves every other radius as it is.
        r = np.sqrt(r2 + 1e-280)
        theta = np.arctan(r)
        t2 = theta * theta
        scale = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) / r
        return u * scale, v * scale

    @staticmethod
    def slope(terms: FloatArray, u: FloatArray, v: FloatArray, r2: FloatArray) -> Slope:
        """Entries 00, 01 (= 10), 11 of the derivative of the distorted by the undistorted coordinates."""
        k1, k2, k3, k4 = terms
        is_near = r2 < 1e-6
        safe = np.where(is_near, 1.0, r2)
        r = np.sqrt(safe)
        theta = np.arctan(r)
        t2 = theta * theta
        scale = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) / r
        grow = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
        by_r2 = (grow / (1 + safe) - scale) / (2 * safe)
        # Near the axis both are 0/0: theta_d / r = 1 + (k1 - 1/3) r2 + O(r2^2).
        scale, by_r2 = np.where(is_near, 1 + (k1 - 1 / 3) * r2, scale), np.where(is_near, k1 - 1 / 3, by_r2)
        twice_u = 2 * by_r2 * u
        return scale + twice_u * u, twice_u * v, scale + 2 * by_r2 * v * v

    @staticmethod
    def by_terms(u: FloatArray, v: FloatArray, r2: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Derivatives of the distorted coordinates by each of the four terms."""
        r = np.sqrt(r2 + 1e-280)
        theta = np.arctan(r)
        t2 = theta * theta
        power = theta / r
        for _ in range(4):
            power = power * t2
            yield u * power, v * power

    @staticmethod
    def fold_r2(terms: FloatArray) -> FloatArray:
        """(c,) squared radius at which the image folds back; infinite where it never does before 90 degrees.

        1 + 3 k1 s + 5 k2 s^2 + 7 k3 s^3 + 9 k4 s^4 = 0 with s = theta^2; in x = 1/s the polynomial is monic, and its
        roots are the eigenvalues of its companion matrix.
        """
        companion = np.zeros((terms.shape[1], 4, 4))
        companion[:, 0] = -np.stack([terms[k].ravel() * (2 * k + 3) for k in range(4)], axis=1)
        companion[:, [1, 2, 3], [0, 1, 2]] = 1.0
        x = np.linalg.eigvals(companion)
        is_root = (np.abs(x.imag) <= 1e-9 * np.abs(x)) & (x.real > (2 / np.pi) ** 2)
        largest = np.where(is_root, x.real, 0.0).max(axis=1)
        theta = 1 / np.sqrt(np.where(largest > 0, largest, 1.0))
        return np.where(largest > 0, np.tan(theta) ** 2, np.inf)


Lens = type[Brown] | type[KannalaBrandt]
