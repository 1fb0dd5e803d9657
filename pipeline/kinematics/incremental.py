"""The incremental solver of Baillot, Rolland & Wright: push along delta, slide and turn at contact, until stable.

The reference stays fixed and the attitude is held. The rules are those of the paper; each motion is tested on the way
with the exact triangles, contact is made by bisection along the motion, and delta is re-established whenever a motion
ended free. Where the paper is silent, this is what is done and why:

contact points
    Closest points of the feature pairs within the contact band at the clear side of exact contact, not the corners of
    colliding triangles: they do not depend on the triangulation.
reaction at a ridge
    The line between the closest points (see :meth:`AttitudeContact.contacts`): a raw face normal at a ridge gives a
    force that no ridge can give.
a torque is possible
    When some centre and turning sense exist for which every contact lets the body advance along delta (the least
    rate of the contacts is positive). Centres: the body's origin, the centroid of the contacts, and the midpoint of
    the two contacts farthest apart; all that promise an advance are tried, the best promise first.
the translation
    Along the in-plane resultant of the reactions if they allow it; else along the best in-plane direction of the same
    least-rate programme.
accepting a motion
    Only if the drop that follows reaches deeper. A motion that does not is undone, which brings the body back to an
    earlier pose: a cycle in the sense of the paper, so its step is halved. ``classic=True`` drops the guard: every
    motion stands, a pose similar to an earlier contact pose (angle and position within the resolutions) is a cycle,
    and only a motion that closed no cycle resets a step, for else two alternating poses would reset one another's.
spent
    A kind of motion whose step fell below its resolution is spent until a step is reset.
ligaments
    They pull as one more reaction does. What counts as deeper is then the merit of a pose (depth less elastic energy
    over the push), and an advance is one of the merit. As they may pull the body uphill, a motion that meets the
    reference goes on, and the body is pulled back along delta as far as it must. A turn about some centre has to
    promise more than the same shift without the turn: else a body that turns freely would be dragged round and round.
before a pose is called stable
    Trials at one resolution to either side in x, y and theta fail to go deeper, and so do joint motions (both
    translations and the rotation together, needed where only the combination advances) that a small linear programme
    over all contacts near by promises, in boxes from twice the resolution down to an eighth. In these trials the body
    may be lifted out of a dent.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import chain
from typing import Literal

import numpy as np

from pipeline.kinematics.contact import AttitudeContact, Contacts, Pose, reaction_rates, reaction_slack, support
from pipeline.kinematics.descent import MotionSettings, drop, move_until_contact
from pipeline.kinematics.joint_coordinates import Float
from pipeline.kinematics.least_rate import best_motion
from pipeline.kinematics.ligaments import NO_LOAD, Load
from pipeline.kinematics.table import Status

Kind = Literal["rotation", "translation"]
Motion = tuple[float, float, float]
KINDS: tuple[Kind, ...] = ("rotation", "translation")

#: Advance along delta per unit of motion below which contacts promise nothing (rounding of the normals).
LEAST_PROMISE = 1e-6
#: So often a joint motion is looked for again with what was learned about the fibres.
MOST_TANGENTS = 20


@dataclass(frozen=True)
class IncrementalSettings:
    """Steps, resolutions and bounds; the defaults are the paper's (step = 10 x resolution).

    Attributes
    ----------
    slide_bound_mm, rotation_bound_rad : float
        A body farther than this from the centre of the bounds has slid off, or turned past its bound.
    contact_band_mm : float
        Features closer than this react.
    gain_mm : float
        Least advance along delta that counts as deeper; above the contact tolerance. Of a merit, this much depth.
    classic : bool
        The paper's plain rules: every motion stands.
    early_rejection : bool
        A motion is given up at the first test that shows it to lead no deeper, instead of being carried out: the same
        poses to the last bit with about half the tests. Not with ``classic``, where every landing stands.
    """

    translation_step_mm: float = 1.0
    translation_resolution_mm: float = 0.1
    rotation_step_rad: float = float(np.radians(1.0))
    rotation_resolution_rad: float = float(np.radians(0.1))
    contact_band_mm: float = 0.05
    gain_mm: float = 5e-4
    slide_bound_mm: float = 25.0
    rotation_bound_rad: float = float(np.radians(45.0))
    max_motions: int = 400
    classic: bool = False
    early_rejection: bool = False
    motion: MotionSettings = field(default_factory=MotionSettings)

    def step(self, kind: Kind) -> float:
        """Original step of a kind (mm or rad)."""
        return self.rotation_step_rad if kind == "rotation" else self.translation_step_mm

    def resolution(self, kind: Kind) -> float:
        """Resolution of a kind (mm or rad)."""
        return self.rotation_resolution_rad if kind == "rotation" else self.translation_resolution_mm


@dataclass(frozen=True)
class StablePose:
    """What the search at one attitude came to.

    Attributes
    ----------
    pose : Pose
        The clear side of exact contact; meaningless unless ``status`` is OK or NOT_CONVERGED.
    status : Status
    motions : int
        Motions made, drops not counted.
    cycles : int
        Cycles met (each halved a step).
    """

    pose: Pose
    status: Status
    motions: int
    cycles: int


@dataclass
class _Search:
    """The changing part of one search."""

    contact: AttitudeContact
    settings: IncrementalSettings
    centre: Pose
    pose: Pose
    steps: dict[Kind, float]
    history: list[Pose]
    last: Kind = "translation"
    motions: int = 0
    cycles: int = 0

    def finished(self, status: Status) -> StablePose:
        return StablePose(self.pose, status, self.motions, self.cycles)

    def spent(self, kind: Kind) -> bool:
        return self.steps[kind] < self.settings.resolution(kind)

    def reset(self) -> None:
        self.steps = {kind: self.settings.step(kind) for kind in KINDS}

    def been_at(self, pose: Pose) -> bool:
        """Whether an earlier contact pose was the same within the resolutions."""
        past = np.asarray(self.history)
        near = np.linalg.norm(past[:, :3] - np.asarray(pose)[:3], axis=1) < self.settings.translation_resolution_mm
        return bool(np.any(near & (np.abs(past[:, 3] - pose.theta) < self.settings.rotation_resolution_rad)))


def solve_incremental(
    contact: AttitudeContact, start: Pose, settings: IncrementalSettings, centre: Pose | None = None
) -> StablePose:
    """The stable pose reached from ``start`` at a held attitude.

    Parameters
    ----------
    contact : AttitudeContact
    start : Pose
        Where the moving body is let go; if it intersects the reference it is first pulled back along delta.
    settings : IncrementalSettings
    centre : Pose, optional
        Middle of the bounds; where the body first touches when not given.

    Returns
    -------
    StablePose
        ``NO_CONTACT`` when nothing is met within the travel or one body is inside the other, ``SLID_OFF`` and
        ``ROTATION_BOUND`` when the body leaves the bounds, ``NOT_CONVERGED`` when the motions run out.
    """
    first = drop(contact, start, settings.motion)
    if first is None or contact.nested(first):
        return StablePose(start, Status.NO_CONTACT, 0, 0)
    search = _Search(contact, settings, centre or first, first, {}, [first])
    search.reset()
    advance = _classic_round if settings.classic else _round
    while search.motions < settings.max_motions:
        status = _out_of_bounds(search) or advance(search)
        if status is not None:
            return search.finished(Status.OK if status == "equilibrium" else status)
    return search.finished(Status.NOT_CONVERGED)


def _out_of_bounds(search: _Search) -> Status | None:
    pose, centre, settings = search.pose, search.centre, search.settings
    away = np.subtract(pose, centre)
    if np.hypot(away[0], away[1]) > settings.slide_bound_mm or away[2] > settings.slide_bound_mm:
        return Status.SLID_OFF
    if abs(away[3]) > settings.rotation_bound_rad:
        return Status.ROTATION_BOUND
    return None


def _round(search: _Search) -> Status | Literal["equilibrium"] | None:
    """What happens at one contact pose: turn, else slide, else equilibrium."""
    options = _options(search)
    for kind in KINDS:
        while options[kind] and not search.spent(kind):
            for direction in options[kind]:
                landed, _ = _try(search, kind, direction)
                if landed is None:
                    return Status.SLID_OFF
                if _deeper(search, landed):
                    _accept(search, kind, landed)
                    return None
                search.cycles += 1
            search.steps[kind] *= 0.5
    return _confirm(search)


def _try(search: _Search, kind: Kind, direction: Motion) -> tuple[Pose | None, bool]:
    """Make one motion of the current step, then re-establish delta; the landing, and whether the motion collided."""
    search.motions += 1
    step = search.steps[kind]
    motion = (direction[0] * step, direction[1] * step, direction[2] * step)
    moved, collided = move_until_contact(search.contact, search.pose, motion, search.settings.motion)
    if collided and search.contact.load(search.pose).energy_mm > 0.0:
        moved = search.pose.displaced(motion)  # perhaps uphill: the drop pulls it back along delta
    return _landed(search, moved), collided


def _landed(search: _Search, moved: Pose) -> Pose | None:
    """Where delta brings the body back to contact; where it stood, if that is seen at once to be no deeper."""
    settings = search.settings
    early = settings.early_rejection and not settings.classic
    if early and search.contact.touches(moved._replace(z=_deep_enough(search))):
        return search.pose  # contact comes sooner, and the energy of fibres only takes from the merit of a depth
    return drop(search.contact, moved, settings.motion)


def _options(search: _Search) -> dict[Kind, list[Motion]]:
    contacts = search.contact.contacts(search.pose, search.settings.contact_band_mm, along_only=True)
    return motion_options(contacts, search.pose, search.contact.load(search.pose))


def _deeper(search: _Search, landed: Pose) -> bool:
    return search.contact.merit(landed) > _deep_enough(search)


def _deep_enough(search: _Search) -> float:
    """The merit that a pose has to exceed to be deeper than where the body stands, mm."""
    return search.contact.merit(search.pose) + search.contact.load(search.pose).push * search.settings.gain_mm


def _accept(search: _Search, kind: Kind, landed: Pose) -> None:
    """Stand at a deeper pose. Steps are reset when delta followed a rotation, or a torque followed a translation."""
    if kind == "rotation":
        search.reset()
    search.pose, search.last = landed, kind


def _classic_round(search: _Search) -> Status | Literal["equilibrium"] | None:
    """The paper's rules without the guard: the first possible motion stands, wherever it leads."""
    options = _options(search)
    kind = next((k for k in KINDS if options[k] and not search.spent(k)), None)
    if kind is None:
        return "equilibrium"
    landed, collided = _try(search, kind, options[kind][0])
    if landed is None:
        return Status.SLID_OFF
    if search.been_at(landed):
        search.cycles += 1
        search.steps[kind] *= 0.5
    elif (kind == "rotation") and (search.last == "translation" or not collided):
        search.reset()
    search.history.append(landed)
    search.pose, search.last = landed, kind
    return None


def _confirm(search: _Search) -> Literal["equilibrium"] | None:
    """Equilibrium when no trial near by goes deeper; else stand at the deeper pose and go on."""
    for trial in chain(_joint_trials(search), _unit_trials(search)):
        search.motions += 1
        landed = _landed(search, trial)
        if landed is not None and _deeper(search, landed):
            search.pose = landed
            search.reset()
            return None
    return "equilibrium"


def _unit_trials(search: _Search) -> list[Pose]:
    shift, turn = search.settings.translation_resolution_mm, search.settings.rotation_resolution_rad
    units = (
        (shift, 0.0, 0.0),
        (-shift, 0.0, 0.0),
        (0.0, shift, 0.0),
        (0.0, -shift, 0.0),
        (0.0, 0.0, turn),
        (0.0, 0.0, -turn),
    )
    return [search.pose.displaced(unit) for unit in units]


def _joint_trials(search: _Search) -> Iterator[Pose]:
    """Joint motions within boxes of halving size; the contacts that matter lie within half the box."""
    p, box = search.pose, 2.0 * search.settings.translation_resolution_mm
    near = search.contact.contacts(p, 0.5 * box, along_only=True)
    while box >= search.settings.translation_resolution_mm / 8.0:
        contacts = near.within(0.5 * box)
        if len(contacts):
            size = (box, box, box / search.settings.motion.radius_mm)
            yield p.displaced(_joint_motion(search, contacts, size))
        box *= 0.5


def _joint_motion(search: _Search, contacts: Contacts, box: tuple[float, float, float]) -> Motion:
    """The motion in a box that promises most, of those that the programme finds as it learns what the fibres do.

    A stiff fibre pulls quite differently a little farther on. Energy curves upwards, so its tangent at any pose bounds
    it from below: each pose that the programme comes to adds such a bound, until one proves as good as promised.
    """
    p, here = search.pose, search.contact.load(search.pose)
    advance, spare = reaction_rates(contacts, p), reaction_slack(contacts)
    rates, slack = reaction_rates(contacts, p, here), reaction_slack(contacts, here)
    tried: list[tuple[float, Motion]] = []
    for _ in range(MOST_TANGENTS):
        motion = best_motion(rates, slack, box)
        depth = float((spare + advance @ motion).min())
        there = search.contact.load(p.displaced(motion)._replace(z=p.z + depth))
        tried.append((depth - there.energy_mm + here.energy_mm, motion))
        if tried[-1][0] >= float((slack + rates @ motion).min()) - LEAST_PROMISE:
            break
        x, y, turn = motion
        bound = here.energy_mm - there.energy_mm + float(there.slope @ [x, y, turn, depth])
        rates = np.vstack([rates, reaction_rates(contacts, p, there)])
        slack = np.concatenate([slack, reaction_slack(contacts, there) + bound])
    return max(tried)[1]


def motion_options(contacts: Contacts, pose: Pose, load: Load = NO_LOAD) -> dict[Kind, list[Motion]]:
    """Directions of each kind, per unit step, that contacts and fibres promise an advance for; best first."""
    if len(contacts) == 0:
        return {kind: [] for kind in KINDS}
    rates = reaction_rates(contacts, pose, load)
    return {"rotation": _rotations(contacts, rates, pose, load), "translation": _translations(contacts, rates, load)}


def _rotations(contacts: Contacts, rates: Float, pose: Pose, load: Load) -> list[Motion]:
    centres = _centres(contacts, pose) - [pose.x, pose.y]
    motions = [(sense * cy, -sense * cx, sense) for cx, cy in centres for sense in (1.0, -1.0)]
    if load.energy_mm > 0.0:
        motions = [motion for motion in motions if _least(rates, motion) > _least(rates, (*motion[:2], 0.0))]
    return _promising(motions, rates)


def _least(rates: Float, motion: Motion) -> float:
    return float((rates @ np.asarray(motion)).min())


def _centres(contacts: Contacts, pose: Pose) -> Float:
    """(3, 2) the body's origin, the centroid of the contacts, the midpoint of the two farthest apart."""
    xy = contacts.points[:, :2]
    centroid = xy.mean(axis=0)
    one = xy[np.argmax(np.linalg.norm(xy - centroid, axis=1))]
    other = xy[np.argmax(np.linalg.norm(xy - one, axis=1))]
    return np.array([[pose.x, pose.y], centroid, 0.5 * (one + other)])


def _translations(contacts: Contacts, rates: Float, load: Load) -> list[Motion]:
    # contacts push alike; so strongly that together they carry the push, the fibres pull as they do
    resultant = contacts.normals[:, :2].sum(axis=0) - load.slope[:2] * (support(contacts).sum() / load.push)
    length = float(np.linalg.norm(resultant))
    motions: list[Motion] = []
    if length > 1e-9 * len(contacts):
        motions.append((float(resultant[0]) / length, float(resultant[1]) / length, 0.0))
    no_slack = np.zeros(len(rates))
    return _promising(motions, rates) or _promising([best_motion(rates, no_slack, (1.0, 1.0, 0.0))], rates)


def _promising(motions: list[Motion], rates: Float) -> list[Motion]:
    promise = [_least(rates, motion) for motion in motions]
    order = sorted(range(len(motions)), key=lambda k: -promise[k])
    return [motions[k] for k in order if promise[k] > LEAST_PROMISE]
