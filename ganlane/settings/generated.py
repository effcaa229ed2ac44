"""Parameters of the drivers that a generator moves.

Those of what is laid over the paper's (``gan``), and the calibrated ones' anchor and lane changes.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from ganlane.settings.driving import IdmParameters, MobilParameters

#: Levels of the headway quantiles.
QUANTILE_LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)
#: Quantiles of (gap - 2 m) / speed of recorded followers on US-101, s: the default where no
#: statistics are given.
HEADWAY_QUANTILES_S = (0.50, 0.93, 1.27, 1.93, 3.27)


@dataclass(frozen=True)
class LiteralChanges:
    """Equations 9 to 11 as printed.

    Attributes:
        mean_steps: ``t_m``, in steps of 0.1 s.
        lateral_speed_mps, lateral_speed_sd_mps: mean and standard deviation of the Gaussian of
            lateral speeds, m/s.
        slowest_mps: lower bound of a drawn speed, so that every change ends, m/s.
    """

    mean_steps: float = 2218.0
    lateral_speed_mps: float = 0.81
    lateral_speed_sd_mps: float = 0.33
    slowest_mps: float = 0.3


@dataclass(frozen=True)
class SuddenAccelerations:
    """Sudden accelerations.

    Attributes:
        every_s: mean time between two, s.
        lasts_s: how long one lasts, s.
        mean, sd: of their Gaussian, m/s2.
    """

    every_s: float = 10.0
    lasts_s: float = 1.0
    mean: float = 0.0
    sd: float = 0.8


@dataclass(frozen=True)
class GuardParameters:
    """Limits of the guard.

    Attributes:
        headway_s: time headway of the IDM acceleration that is the upper bound.
        slack: the lower bound is IDM's acceleration minus this, m/s2, times speed over desired
            speed, so that a network that always slows ends at a crawl instead of standing still on
            a free road.
        hardest_braking: lowest acceleration, m/s2.
        centring_per_s: rate at which the offset from the target lane's centre is reduced (the P of
            the PD).
        damping: share of the network's lateral motion that is kept (the D).
        edge_margin_m: minimum distance of the turned body from the edge of the road.
        steepest_rad: largest angle to the road.
    """

    headway_s: float = 0.8
    slack: float = 1.5
    hardest_braking: float = -8.0
    centring_per_s: float = 0.5
    damping: float = 0.8
    edge_margin_m: float = 0.1
    steepest_rad: float = 0.2


@dataclass(frozen=True)
class AnchorParameters:
    """The anchor and the bounds of the residual; accelerations in m/s2.

    Attributes:
        idm: Table V; braking is limited to 8 m/s2, the grip of a dry road.
        lane_stiffness: pull to the target lane's centre, 1/s2.
        lane_damping: of the lateral velocity, 1/s; with the stiffness critically damped.
        residual: largest residual along and across the road.
        washout_s: time constant of the residual's mean, which is subtracted, s.
        further_inputs: whether the network gets gap, closing speed, IDM's acceleration and lane
            offset. Weights of ablations (up to 0.3.0) have other values of these two.
    """

    idm: IdmParameters = field(default_factory=lambda: IdmParameters(min_acceleration=-8.0))
    lane_stiffness: float = 0.3
    lane_damping: float = 1.1
    residual: tuple[float, float] = (4.0, 2.0)
    washout_s: float = 3.0
    further_inputs: bool = True


ANCHOR = AnchorParameters()


@dataclass(frozen=True)
class CalibratedChanges:
    """A rate per kilometre driven, and what makes a gap good enough.

    Attributes:
        per_km: hazard of *wishing* for a change, set so that the rate *measured in the simulation*
            is that of the data; waiting for a gap makes the two differ.
        patience_s: a wish that finds no gap for this long is given up, s.
        safe_deceleration: no vehicle has to brake harder, by IDM, m/s2.
        exclusive_m: a change does not start while another vehicle is moving into the same lane
            within this distance; of several that would start at once only the foremost does, m.
    """

    per_km: float = 0.92
    patience_s: float = 20.0
    safe_deceleration: float = 2.0
    exclusive_m: float = 60.0

    def limits(self) -> MobilParameters:
        """The limits of a lane change, as MOBIL has them."""
        return MobilParameters(
            safe_deceleration=self.safe_deceleration, exclusive_m=self.exclusive_m
        )
