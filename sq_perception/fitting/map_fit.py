"""prototype"""
from __future__ import annotations
import math, os, time
from dataclasses import replace
from typing import NamedTuple
import numpy as np
from sq_perception.fitting import box_start, revolution
from sq_perception.fitting.covariance import Alternative
from sq_perception.fitting.hull_prior import HullPrior
from sq_perception.fitting.levenberg_marquardt import State, minimize
from sq_perception.fitting.residuals import RENDERED, SAMPSON
from sq_perception.fitting.search import Search

E = lambda k, d: float(os.environ.get(k, d))
RW, FW = E('RW', 50), E('FW', 0.3)
PW = E('PW', 1.0)
ROUND = E('ROUND', 1)
REST = E('REST', 0.05)
COARSE = int(E('COARSE', 200)); FINAL = int(E('FINAL', 800))

def run(search: Search, prior: HullPrior | None, predicted, plane) -> State:
    o = search.observation
    scene = search.scene._replace(huber=2.0, inner_cauchy=E('IC', 0), proportion_stiffness=E('PROP', 0.0), volume_price=E('VP', 0), rest_stiffness=(1 / REST if plane is not None and REST > 0 else 0.0))
    if prior is not None:
        scene = scene._replace(hull_directions=np.ascontiguousarray(prior.directions), hull_support=prior.support, hull_root=prior.root() * math.sqrt(PW), hull_freedom=prior.freedom)
    def draw(count, offset):
        rays, free = search._draw(count, offset)
        rays = rays.copy(); free = free.copy()
        rays[:, 6] *= RW / 50.; free[:, 6] *= FW * RW / 50.
        return rays, free
    starts = []
    if predicted is not None:
        p = State.of(predicted)
        starts += [p]
    starts += box_start.on_plane(o.points, plane) if plane is not None else box_start.principal(o.points)
    few = draw(COARSE, 0.7)
    lim = search.limits
    first = sorted((minimize(RENDERED, *few, scene, s, lim, 6, 1e-3) for s in starts), key=lambda s: s.cost)[:4]
    settled = sorted((minimize(RENDERED, *few, scene, s, lim, 15, 1e-3) for s in first), key=lambda s: s.cost)
    rays, free = draw(FINAL, 0.3)
    best = minimize(RENDERED, rays, free, scene, settled[0], lim, 40, 1e-4)
    notes = []
    if ROUND:
        rscene = scene._replace(roundness_stiffness=1 / revolution.SIGMA)
        rs = revolution.from_body(best)
        if plane is not None:
            rs += revolution.on_plane(o.points, plane)
        rs = sorted((minimize(RENDERED, *few, rscene, s, lim, 8, 1e-3) for s in rs), key=lambda s: s.cost)[:2]
        rb = min((minimize(RENDERED, rays, free, rscene, s, lim, 25, 1e-4) for s in rs), key=lambda s: s.cost)
        gain = best.cost - rb.cost + E('RG', 3.0)
        w = 1 / (1 + math.exp(min(50, abs(gain)) / 2))
        if gain > 0:
            search.alternatives = [Alternative(best, w)]
            best = rb; scene = rscene
            notes.append('taken for a body of revolution')
        else:
            search.alternatives = [Alternative(rb, w)]
    search.scene = scene; search.rays = rays; search.free = free; search.notes = notes
    return best
