"""The course of one surface fit, from the first start to the last iteration.

1. Starts, cheap ones first: given bodies, central symmetry, boxes on the support plane.
2. From each, a few Levenberg-Marquardt steps on the Sampson residual and free space with some 150 rays: a wide basin.
   More starts only while the best residual stays above the noise floor.
3. Those that the noise does not tell apart go on: Sampson with more rays, then the rendered residual.  If the winner's
   residual is above the floor, its rivals are tried (:mod:`sq_perception.fitting.rivals`), then all starts.
4. The winner, and whatever still rivals it: rays far off its surface are dropped, the outline's precision is read from
   its misfit, and again from the better body that this allows, and the rendered residual is minimised on all rays.
5. Where something is left unexplained, or a half size is not certain to 1 %, the rivals of the result are tried, few
   rays first.  Those that explain the image almost as well stay as alternatives and add to the covariance.
6. Rounded readings of a face that looks at the camera are treated apart (:mod:`sq_perception.fitting.rounding`).
7. If no superquadric reaches the floor, what is left becomes the model error, and stages 2 to 4 run once more with it:
   then neighbouring pixels err alike, the object counts as few independent rays, and wide priors decide what is open.
   There all starts compete, and what no superquadric comes near is fitted as a hull, the space beside it let go.
8. A half size that stays open is also tried as the others, thin, and as predicted, with the seen face in place, and the
   body as one of revolution (:mod:`sq_perception.fitting.revolution`).

The noise floor is a mean squared residual of 1, as residuals are in units of the noise.
"""

from __future__ import annotations

import math
import time

import numpy as np

from sq_perception.fitting import box_start, revolution, rounding, symmetry_start
from sq_perception.fitting.covariance import Alternative, covariance_at, undetermined
from sq_perception.fitting.levenberg_marquardt import State, minimize
from sq_perception.fitting.observation import Observation
from sq_perception.fitting.options import Options
from sq_perception.fitting.residuals import RAY_COLUMNS, RENDERED, SAMPSON, penetration, surface_distance
from sq_perception.fitting.rivals import SIGNIFICANT, alike, other_axes, other_depths, resized
from sq_perception.fitting.scene import Scene
from sq_perception.geometry.superquadric import Superquadric

COARSE_RAYS, COARSE_STEPS = 150, 8
BASIN_RAYS, BASIN_STEPS = 300, 15
FINAL_RAYS = 3000
MOST_FINAL_RAYS = 6000
FREE_SHARE = 0.25
"""Free rays per object ray."""
COARSE_GATE = 3.6
FINAL_GATE = 1.4
"""Mean squared residuals above which more starts are tried."""
DOUBT = 25.0
"""Bodies whose costs differ by D on the same rays differ by 2 sqrt(D) through noise: below this they go on together,"""
RIVAL = 1.3
"""and so do those within this factor of the best, as they have not converged yet."""
FINALISTS, ESCALATED_FINALISTS, ROUND_FINALISTS = 3, 6, 2
TOLERANCE, FINAL_TOLERANCE = 1e-3, 1e-4
SHARP_OUTLINE = 0.3
"""Standard deviation of a perfect outline, in pixels: the body covers exactly the centres of the mask's pixels."""
SHRUNK, MOST = 0.25, 0.7
"""A body that covers most of the free pixels beside the mask this deep, in pixels, is larger than its mask."""
WIDEST_BAND = 4
MOST_SHARPENINGS, SHARPENING_STEPS, SHARPER = 4, 6, 0.7
RING_RAYS = 200
HIT_TOLERANCE = 3e-3
"""Rays remember where they met the body, so that this error of g vanishes as the search converges."""
OUTLIER = 5.0
"""Object rays this many standard deviations off the surface of the winner are dropped."""
SETTLED, UNSURE = 1.03, 0.01
"""A last mean squared residual above the one, or a half size less certain than the other, as a share of it, make other
valleys of the cost worth a look."""
OPEN = 0.1
"""A half size less certain than this share of it may be anything that the image allows."""
MOST_VARIATIONS = 2
RIVAL_SLACK = 4.0
"""Cost that few rays may hide."""
FIRST_STEPS, HOPELESS = 5, 2.0
"""A rival that costs so many times more than the body at hand after its first steps is given up."""
MORE_RAYS = 1500
PROMISING = 24
"""So many bodies of the exact search start the one that tolerates a model error."""
THIN = 0.3
"""A size that the image leaves open is also tried this thin, as a share of the other two."""
MEDIAN_TO_SIGMA = 1.4826
PLANE_SIGMA, GAP_SIGMA, REST_SIGMA = 0.001, 0.005, 0.05
"""Metres below the plane and above it, and sine of the angle between the normal and an axis of the body."""
VOLUME_PRICE = 0.5
OUTER_HUBER, INNER_CAUCHY = 2.0, 1.0
"""Objects that are no superquadrics are hollow and notched, not hairy: a point may well lie behind the surface of the
body that encloses the object, but not in front of it."""
EXPECTATION_SIGMA = 0.25
"""Of a log half size against the network's: its errors on household things, of which one in ten is far off."""
PROPORTION_SIGMA = 1.0
"""Of a log size against the mean of the three: a wide prior."""
MODEL_SPREAD = 2.5**2
"""Factor of the covariance for objects that are no superquadrics, whose errors are alike; read from scanned objects."""
REAL_WEIGHT, REAL_RAYS = 50.0, 800
"""Model errors of neighbouring pixels are alike: an object on a table counts as so many independent rays, however many
are drawn."""


Rays = tuple[np.ndarray, np.ndarray]
"""Of the object and of free space."""


class Search:
    """One search; ``scene``, ``rays`` and ``free`` are those of the stage it is in, after :meth:`run` of the last."""

    def __init__(self, observation: Observation, options: Options, began: float) -> None:
        self.observation = observation
        self.options = options
        self.began = began
        self.limits = options.bounds.limits(observation.points)
        self.tolerated = options.tolerated
        self.scene = _scene(observation, options)
        self.finalists: list[State] = []
        self.tried: list[State] = []
        self.alternatives: list[Alternative] = []
        self.as_hull = False
        self.notes: list[str] = []
        """What the body rests on beyond the image, in words."""
        self.spread_factor = MODEL_SPREAD if self.tolerated > 0 else 1.0
        self._refined_rivals: list[State] = []
        self._symmetry_tried = False
        self._prior: Superquadric | None = None
        self.rays = np.empty((0, RAY_COLUMNS))
        self.free = np.empty((0, RAY_COLUMNS))

    def explained(self, given: list[State]) -> bool:
        """Whether the given starts, or the cheapest automatic ones, lead to a body that leaves nothing but noise.

        If so, :meth:`decided` finishes it.  May be called again with other starts.
        """
        if given:
            self._select(self._coarse(given), FINALISTS)
        if not self._good_enough() and not self._symmetry_tried:
            self._symmetry_tried = True
            self._select(self._coarse(self._symmetric_tiers()[0]), FINALISTS)
        return self._good_enough()

    def run(self, given: list[State]) -> State:
        """The best body from the given starts and, as far as needed, from automatic ones."""
        if given:
            self._select(self._coarse(given), FINALISTS)
        # A wrong valley is good enough soon where a model error is tolerated: there, all starts compete.
        enough = self._good_enough() and self.tolerated == 0
        if not given or (self.options.fall_back and not enough and not self._late()):
            self._select(self._automatic(), FINALISTS)
            if not self._good_enough() and self.tolerated == 0 and not self._late():
                self._look_around()
            if not self._good_enough() and self.tolerated == 0 and not self._late():
                self._select(self._coarse(self._everything()), ESCALATED_FINALISTS)
            if not self._good_enough() and self.tolerated == 0 and not self._late():
                self._tolerate_what_is_left()
                promising = sorted(self.tried, key=_cost)[:PROMISING]
                self._select(self._coarse(promising), ESCALATED_FINALISTS)
        return self.decided()

    # Starts

    def _automatic(self) -> list[State]:
        found: list[State] = []
        for tier in self._tiers():
            found += self._coarse(tier)
            found.sort(key=_cost)
            if found[0].cost < COARSE_GATE * self._weight(COARSE_RAYS) or self._late():
                break
        return found

    def _tiers(self) -> list[list[State]]:
        """Groups of starts, in the order in which to try them."""
        tiers = self._symmetric_tiers()
        if self.options.plane is not None:
            tiers[0] += box_start.on_plane(self.observation.points, self.options.plane)
        return tiers

    def _symmetric_tiers(self) -> list[list[State]]:
        """Starts from central symmetry; from the points' box where nothing shows the symmetry."""
        completed = symmetry_start.completed_moments(self.observation)
        if completed is None:
            return [box_start.principal(self.observation.points)]
        centre, moments = completed
        axes = symmetry_start.principal_axes(moments)
        turns = [axes, *symmetry_start.eighth_turns(axes)]
        return [symmetry_start.states(centre, moments, turned) for turned in turns]

    def _everything(self) -> list[State]:
        """All starts at once, for images on which the first ones failed."""
        found = box_start.principal(self.observation.points)
        completed = symmetry_start.completed_moments(self.observation)
        if completed is None:
            return found
        centre, moments = completed
        axes = symmetry_start.principal_axes(moments)
        deeper = centre + np.array([0.0, 0.0, 0.5 * math.sqrt(float(np.trace(moments)) / 3)])
        for middle in (centre, deeper):
            for exponent in (0.3, 0.8):
                for turned in [axes, *symmetry_start.eighth_turns(axes), *symmetry_start.double_turns(axes)]:
                    found += symmetry_start.states(middle, moments, turned, exponent)
        return found

    def _tolerate_what_is_left(self) -> None:
        """The object is no superquadric: what the best body leaves unexplained becomes the model error."""
        best = self.finalists[0]
        distance = surface_distance(self.observation.object_rays(FINAL_RAYS), best.parameters, best.rotation)
        self.tolerated = MEDIAN_TO_SIGMA * float(np.median(distance))
        self.observation = self.observation.coarsened(self.tolerated)
        self.scene = _scene(self.observation, self.options)._replace(
            huber=OUTER_HUBER, inner_cauchy=INNER_CAUCHY, volume_price=VOLUME_PRICE
        )
        self.finalists = []
        self.spread_factor = MODEL_SPREAD

    def _take_for_hull(self) -> None:
        """No superquadric comes near the object: look for one that resembles its convex hull.

        What lies within the outline's hull, such as the space beside the neck of a bottle, then binds no longer.
        """
        observation = self.observation.of_hull()
        if len(observation.free) == len(self.observation.free):
            return
        self.observation = observation
        self.as_hull = True
        self.notes.append("like the convex hull of the object")
        self.finalists = []
        self._select(self._coarse(sorted(self.tried, key=_cost)[:PROMISING]), ESCALATED_FINALISTS)

    # Stages

    def _draw(self, count: int, offset: float) -> Rays:
        """Object and free rays for one stage."""
        rays = self.observation.object_rays(count, offset)
        free = self.observation.free_rays(int(FREE_SHARE * count), offset)
        if self.tolerated > 0:
            pixels = len(self.observation.pixels)
            rays[:, 6] = REAL_WEIGHT / len(rays)
            if len(free):
                free[:, 6] = REAL_WEIGHT / pixels * self.observation.free_pixels / len(free)
        return rays, free

    def _weight(self, count: int) -> float:
        """Total weight of the object rays that a stage draws: its cost at the noise floor."""
        if self.tolerated > 0:
            return REAL_WEIGHT
        return float(min(count, len(self.observation.pixels)))

    def _coarse(self, states: list[State]) -> list[State]:
        rays, free = self._draw(COARSE_RAYS, 0.5)
        found = []
        for state in states:
            found.append(minimize(SAMPSON, rays, free, self.scene, state, self.limits, COARSE_STEPS, TOLERANCE))
            if self._late():
                break
        self.tried += found
        return found

    def _select(self, candidates: list[State], finalists: int) -> None:
        """Refine the best candidates; those that come out best, and what is there already, are the finalists."""
        rays, free = self._draw(BASIN_RAYS, 0.7)
        for stage in (SAMPSON, RENDERED):
            candidates = [
                minimize(stage, rays, free, self.scene, candidate, self.limits, BASIN_STEPS, TOLERANCE)
                for candidate in self._rivals(candidates)[:finalists]
            ]
        self.finalists = self._rivals(self.finalists + candidates)[:FINALISTS]

    def _look_around(self) -> None:
        """Try the rivals of the favourite."""
        rays = self._draw(BASIN_RAYS, 0.7)
        best = self._settled(self.finalists[0], rays, BASIN_STEPS)
        rivals = other_depths(best, np.argsort(-np.abs(best.rotation[2]))) + other_axes(best)
        self.finalists = self._rivals([*self.finalists, *self._promising(rivals, rays, best.cost)])[:FINALISTS]

    def _rivals(self, candidates: list[State]) -> list[State]:
        """Candidates, best first, without those that the noise cannot have made worse than the best."""
        ranked = sorted(candidates, key=_cost)
        least = ranked[0].cost
        return [state for state in ranked if state.cost <= least + max(DOUBT, (RIVAL - 1) * abs(least))]

    def decided(self) -> State:
        """The last stage: the finalists on the full budget of rays, one scene for all of them."""
        if self.tolerated > 0 and not self._good_enough() and not self._late():
            self._take_for_hull()
        finalists = self.finalists
        favourite = finalists[0]
        if self.tolerated == 0 and not self._late():
            favourite = self._outlined(favourite)
        self.rays, self.free = self._draw(self.options.pixels or self._enough(), 0.3)
        if self.tolerated == 0:
            self.rays = self._without_outliers(self.rays, favourite)
            finalists = self._shortlist([self._sharpened(favourite), *self.finalists[1:]])
        else:
            excess = max(1.0, favourite.cost / REAL_WEIGHT)
            self.rays[:, 6] /= excess
            self.free[:, 6] /= excess
        best = self._refined(finalists[0], self.options.max_iterations)
        for rival in finalists[1:]:
            if self._late():
                break
            state = self._refined(rival, self.options.max_iterations)
            best = min(best, state, key=_cost)
        if self.tolerated == 0:
            best = self._varied(best)
            best = self._spread_along_view(best)
        pinhole = self.observation.camera.is_pinhole
        # An exact body's symmetry is judged on all its rays, before doubts about the model lessen their weight.
        steps = (self._rounded, self._doubted) if self.tolerated == 0 else (self._doubted, self._rounded)
        for step in steps:
            if not self._late() and (pinhole or step == self._doubted):
                best = step(best)
        self.scene = self._expecting(self.scene, best)
        return best

    def _rounded(self, free: State) -> State:
        """Read a body as one of revolution where that explains as much, unless the image leaves nothing open."""
        if self._late() or (self.tolerated == 0 and self.options.plane is None):
            return free
        covariance = covariance_at(free, self.rays, self.free, self._expecting(self.scene, free), self.outline)
        unsure = np.sqrt(self.spread_factor * np.diag(covariance)[:3]) / free.parameters[:3]
        if (unsure < revolution.OPEN).all() and free.cost < revolution.EXPLAINED * self.rays[:, 6].sum():
            return free
        plain, self.scene = self.scene, self.scene._replace(roundness_stiffness=1 / revolution.SIGMA)
        starts = revolution.from_body(free)
        if self.options.plane is not None:
            starts += revolution.on_plane(self.observation.points, self.options.plane)
        rays, beside = self._draw(COARSE_RAYS, 0.5)
        coarse = [
            minimize(SAMPSON, rays, beside, self._expecting(self.scene, s), s, self.limits, COARSE_STEPS, TOLERANCE)
            for s in starts
        ]
        few = self._draw(BASIN_RAYS, 0.7)
        promising = sorted(coarse, key=_cost)[:ROUND_FINALISTS]
        settled = sorted((self._settled(s, few, BASIN_STEPS) for s in promising), key=_cost)
        round_scene, self.scene = self.scene, plain
        reference = self._settled(free, few, FIRST_STEPS)
        if revolution.gain(reference.cost, settled[0].cost, float(few[0][:, 6].sum())) < -revolution.HOPELESS:
            return free
        self.scene = round_scene
        best = self._best_refined(settled, self.options.max_iterations)
        gain = revolution.gain(free.cost, best.cost, float(self.rays[:, 6].sum()))
        chosen, other = (best, free) if gain > 0 else (free, best)
        weight = math.exp(-0.5 * abs(gain))
        self.alternatives = [*self.alternatives, Alternative(other, weight / (1 + weight))]
        if gain <= 0:
            self.scene = plain
        else:
            self.notes.append("taken for a body of revolution")
        return chosen

    def _spread_along_view(self, best: State) -> State:
        """Ask for all half sizes along the view that the image allows, where readings are rounded or say little."""
        if self._late():
            return best
        quantum = self.observation.noise.quantum
        if quantum > 0 and rounding.faces_camera(self.rays, quantum):
            best, allowed = rounding.plausible(best, self.rays, self.free, self.scene, self.limits)
            if allowed:
                self.alternatives, self.spread_factor = allowed, rounding.FACE_SPREAD**2
        elif quantum == 0:
            covariance = covariance_at(best, self.rays, self.free, self.scene, self.outline)
            if (np.sqrt(np.diag(covariance)[:3]) > OPEN * best.parameters[:3]).any():
                self.alternatives = rounding.uncertain(best, self.rays, self.free, self.scene, self.limits)
        return best

    def _shortlist(self, finalists: list[State]) -> list[State]:
        """The finalists, best first, that are worth all rays."""
        if len(finalists) == 1:
            return finalists
        rays = self._draw(MORE_RAYS, 0.3)
        settled = sorted((self._settled(state, rays, BASIN_STEPS) for state in finalists), key=_cost)
        chosen: list[State] = []
        for state in settled:
            if state.cost < settled[0].cost + RIVAL_SLACK and not any(alike(state, other) for other in chosen):
                chosen.append(state)
        return [state._replace(cost=math.inf) for state in chosen]

    def _sharpened(self, state: State) -> State:
        """Read the outline's precision from a body's misfit, and again from the better body that this allows."""
        rays, free = self._draw(self._enough() // 4, 0.3)
        sigma = math.inf
        for _ in range(MOST_SHARPENINGS):
            before, sigma = sigma, self._outline_sigma(state)
            if sigma > SHARPER * before:
                break
            self.scene = self.scene._replace(outline_stiffness=1 / sigma)
            state = state._replace(cost=math.inf)
            state = minimize(RENDERED, rays, free, self.scene, state, self.limits, SHARPENING_STEPS, TOLERANCE)
        return state

    def _varied(self, best: State) -> State:
        """Look beyond the valley that the search came down into: noise and poor sight hide that another one is deeper.

        Rivals are the same body with a half size that the image hardly tells made smaller or larger, the seen face in
        place, and, where something is left unexplained, the same box of axes with another z or turned by 45 degrees.
        They go on with the rendered residual: Sampson's would make them grow, as g is convex and noise enters it.
        """
        for _ in range(MOST_VARIATIONS):
            unexplained = best.cost > SETTLED * self.rays[:, 6].sum()
            unsure = np.sqrt(np.diag(covariance_at(best, self.rays, self.free, self.scene, self.outline))[:3])
            unsure /= best.parameters[:3]
            if self._late() or not (unexplained or unsure.max() > UNSURE):
                break
            rivals = other_depths(best, np.argsort(-unsure))
            if unexplained:
                rivals += other_axes(best)
            better = self._better(best, rivals)
            if better is best:
                break
            self._refined_rivals.append(best)
            best = better
        self.alternatives = self._alternatives(best)
        return best

    def _better(self, best: State, rivals: list[State]) -> State:
        """The best of a body and its rivals: these must not be worse on few rays before they are tried on more."""
        few = self._draw(BASIN_RAYS, 0.2)
        reference = self._settled(best, few, BASIN_STEPS)
        # On other rays the body may already find its way out of a shallow valley.
        settled = [best._replace(cost=reference.cost)]
        for state in [reference, *self._promising(rivals, few, reference.cost)]:
            if state.cost < reference.cost + RIVAL_SLACK and not any(alike(state, other) for other in settled):
                settled.append(state)
        if len(settled) == 1:
            return best
        more = self._draw(MORE_RAYS, 0.8)
        reference = self._settled(best, more, BASIN_STEPS)
        for rival in sorted(settled[1:], key=_cost)[:FINALISTS]:
            state = self._settled(rival, more, BASIN_STEPS)
            if state.cost > reference.cost + RIVAL_SLACK or self._late():
                continue
            state = self._refined(state._replace(cost=math.inf), self.options.max_iterations)
            self._refined_rivals.append(state)
            if state.cost < best.cost - SIGNIFICANT:
                best = state
        return best

    def _promising(self, rivals: list[State], rays: Rays, cost: float) -> list[State]:
        """Rivals on few rays, some steps at a time: those that stay far behind are given up."""
        found = []
        for rival in rivals:
            if self._late():
                break
            state = self._settled(rival, rays, FIRST_STEPS)
            if state.cost < HOPELESS * cost:
                found.append(self._settled(state, rays, BASIN_STEPS - FIRST_STEPS))
        return found

    def _settled(self, state: State, rays: Rays, steps: int) -> State:
        state = state._replace(cost=math.inf)
        return minimize(RENDERED, *rays, self._expecting(self.scene, state), state, self.limits, steps, TOLERANCE)

    def _alternatives(self, best: State) -> list[Alternative]:
        """The other valleys that explain the image almost as well."""
        others = [state for state in self._refined_rivals if not alike(state, best)]
        weights = np.array([math.exp(-0.5 * max(state.cost - best.cost, 0.0)) for state in others])
        return [Alternative(state, weight / (1 + weights.sum())) for state, weight in zip(others, weights, strict=True)]

    def _doubted(self, state: State) -> State:
        """Where the image hardly tells a size, small model errors would decide it: leave it to the priors instead.

        The same body with that size like the others, or as small as can be, its seen face in place, competes.
        """
        covariance = covariance_at(state, self.rays, self.free, self.scene, self.outline) * self.spread_factor
        weak = np.flatnonzero(undetermined(covariance, state.parameters[:3]))
        pinhole = self.observation.camera.is_pinhole
        if len(weak) == 0 or not (pinhole or self.options.expected is not None):
            return state
        if self.tolerated == 0 and pinhole:
            weight = REAL_WEIGHT / self.rays[:, 6].sum()
            self.rays[:, 6] *= weight
            self.free[:, 6] *= weight
            self.scene = self.scene._replace(volume_price=VOLUME_PRICE)
        rivals = [state]
        for k in weak:
            typical = float(np.exp(np.mean(np.log(np.delete(state.parameters[:3], k)))))
            rivals += [resized(state, int(k), size) for size in (typical, THIN * typical)]
        self._prior = self._expected()
        if self._prior is not None:
            self.scene = self.scene._replace(expectation_stiffness=1 / EXPECTATION_SIGMA)
            self.notes.append("half sizes weighed against a prediction")
            extents = self._prior.support(state.rotation.T)
            rivals += [resized(state, int(k), float(extents[k])) for k in weak]
        few = self._draw(BASIN_RAYS, 0.2)
        share = self.rays[:, 6].sum() / few[0][:, 6].sum()
        for rays in few:
            rays[:, 6] *= share
        promising = sorted((self._settled(rival, few, BASIN_STEPS) for rival in rivals), key=_cost)
        steps = 2 * self.options.max_iterations
        return self._best_refined(promising, steps)

    def _best_refined(self, settled: list[State], steps: int) -> State:
        """The best of some bodies, ranked on few rays, on all of them; the second one only if the ranking is close."""
        chosen = [s for s in settled[:2] if s.cost < settled[0].cost + RIVAL_SLACK]
        return min((self._refined(state._replace(cost=math.inf), steps) for state in chosen), key=_cost)

    def _expected(self) -> Superquadric | None:
        expected = self.options.expected
        return expected() if callable(expected) else expected

    def _expecting(self, scene: Scene, state: State) -> Scene:
        """The scene with the expected half sizes along the axes that the state has now."""
        if self._prior is None:
            return scene
        x, y, z = (float(extent) for extent in self._prior.support(state.rotation.T))
        return scene._replace(expected_1=x, expected_2=y, expected_3=z)

    @property
    def outline(self) -> float:
        """Standard deviation of the outline where it is not known better, metres."""
        return max(self.observation.sigma, self.observation.footprint)

    def _refined(self, state: State, steps: int) -> State:
        scene = self._expecting(self.scene, state)
        return minimize(RENDERED, self.rays, self.free, scene, state, self.limits, steps, FINAL_TOLERANCE)

    def _outlined(self, state: State) -> State:
        """Forget the free rays next to the mask if the mask turns out to be smaller than the body."""
        full = self.observation
        if self._penetration(state, full.rim()) < SHRUNK:
            return state
        self.observation = full.beyond(WIDEST_BAND)
        self.rays, self.free = self._draw(FINAL_RAYS, 0.6)
        state = self._refined(state._replace(cost=math.inf), BASIN_STEPS)
        rings = (k for k in range(1, WIDEST_BAND + 1) if self._penetration(state, full.ring(k)) < SHRUNK)
        band = next(rings, WIDEST_BAND + 1) - 1
        self.observation = full.beyond(band) if band > 0 else full
        return state

    def _penetration(self, state: State, pixels: np.ndarray) -> float:
        """Depth, in pixels, to which the body covers most of these free pixels.

        Most: a body that is merely too long covers those around the mask on one side only.
        """
        rays = self.observation.free_rays_of(pixels, RING_RAYS)
        if len(rays) == 0:
            return 0.0
        depth = penetration(rays, self.scene, state.parameters, state.rotation)
        return float(np.quantile(depth, 1 - MOST)) / self.observation.footprint

    def _enough(self) -> int:
        """Rays that bring the noise of the mean well below a pixel's width, or all that errors of the model allow."""
        if self.tolerated > 0:
            return REAL_RAYS
        ratio = self.observation.sigma / self.observation.footprint
        return int(np.clip(FINAL_RAYS * (ratio / 0.3) ** 2, FINAL_RAYS, MOST_FINAL_RAYS))

    def _without_outliers(self, rays: np.ndarray, state: State) -> np.ndarray:
        """The rays whose points lie near the surface, as seen by the majority."""
        distance = surface_distance(rays, state.parameters, state.rotation)
        spread = max(self.observation.sigma, 1.4826 * float(np.median(distance)))
        return rays[distance < OUTLIER * spread]

    def _outline_sigma(self, state: State) -> float:
        """Standard deviation of the outline, metres, from how far the body reaches into free rays beside the mask."""
        sharp = SHARP_OUTLINE * self.observation.footprint
        if len(self.free) == 0:
            return sharp
        depth = penetration(self.free, self.scene, state.parameters, state.rotation)
        reached = depth[depth > 0]
        if len(reached) < 3:
            return sharp
        return max(sharp, float(np.sqrt(np.mean(reached**2))))

    # Verdicts

    def _good_enough(self) -> bool:
        return bool(self.finalists) and self.finalists[0].cost < FINAL_GATE * self._weight(BASIN_RAYS)

    def _late(self) -> bool:
        return time.perf_counter() - self.began > self.options.time_budget


def _scene(observation: Observation, options: Options) -> Scene:
    """The constants that the residuals share, for all but the last stage."""
    pinhole = 1.0 if observation.camera.is_pinhole else 0.0
    outline = max(observation.sigma, observation.footprint, options.tolerated)
    scene = Scene(
        hit_tolerance=HIT_TOLERANCE,
        pinhole=pinhole,
        outline_stiffness=1 / outline,
        proportion_stiffness=1 / PROPORTION_SIGMA,
    )
    if options.plane is None:
        return scene
    if options.tolerated > 0:
        # Points behind the surface are what a hull leaves over.  Of an exact superquadric they are noise like those
        # before it, and weighing them less would pull the body towards the camera by half of that noise.
        scene = scene._replace(huber=OUTER_HUBER, inner_cauchy=INNER_CAUCHY)
    x, y, z, offset = (float(value) for value in options.plane)
    return scene._replace(
        normal_x=x,
        normal_y=y,
        normal_z=z,
        offset=offset,
        plane_stiffness=1 / PLANE_SIGMA,
        gap_stiffness=1 / GAP_SIGMA,
        rest_stiffness=1 / REST_SIGMA,
        volume_price=VOLUME_PRICE,
    )


def _cost(state: State) -> float:
    return state.cost
