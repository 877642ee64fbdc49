"""scratch pipeline"""
from __future__ import annotations
import attrs, numpy as np
from .engine.identify import Options, gathered, _read
from .engine.eam import WINDOWS, pd_torque
from .criterion import Parts, clusters, noise_variance, LEVEL
from .model import Model
from .fit import fit
from .library import SignalTerm
from .selection import Search, Account
from . import engine

def parts_of(samples, material):
    if material.heldout:
        report = (samples.log_of_row >= material.fitted)[:, None]
    spans = [one.log.duration for one in samples.logs]
    length = float(np.clip(min(spans) / 20, 0.2, 2.0))
    at = np.floor(samples.t / length).astype(int) % 4
    if material.heldout:
        at = np.floor(samples.t / length).astype(int) % 3
        sel = (at == 1)[:, None] & ~report
        fitr = (at != 1)[:, None] & ~report
    else:
        report = (at == 3)[:, None]; sel = (at == 1)[:, None]; fitr = (at % 2 == 0)[:, None]
    j = samples.judged
    return Parts(j & fitr, j & sel, j & report, clusters(samples))

class R: pass

def identify(train, heldout=(), options=None, progress=lambda share, text: None):
    options = options or Options()
    material = gathered(train, heldout, options.gains, options.values, progress)
    samples, judge, eam, remark = _read(material, WINDOWS)
    parts = parts_of(samples, material)
    joints = len(samples.joints)
    one = np.zeros(joints, dtype=np.intp)
    start = Model(samples, eam.window, eam.gains, np.array([one, one]), np.stack([eam.input_delay, eam.output_delay]), one)
    start = fit(start, parts.fit)
    noise = noise_variance(samples, parts.every, start.residual())
    search = Search(parts, noise)
    import os
    before = search.fitted(start)
    best = search.best(before.model)
    best = search.dropped(best)
    if os.environ.get("V"): print("final", best.model.gains, best.model.delays*1e3, [(o.law.name, o.values) for o in best.model.applied if not isinstance(o.law, SignalTerm)])
    # report
    rep = parts.report
    def mse(e, rows): return float(np.sum(np.where(rows, e, 0)**2)/max(rows.sum(),1))
    b = before.residual; a = best.model.foretold().residual()
    effects=[]
    names=np.array(samples.joints)
    for k, o in enumerate(best.model.applied):
        less = search.fitted(best.model.without(k))
        c = parts.compare(less.residual, best.residual, rep)
        riv = search.rivals(best, k)
        effects.append({"name": o.law.name, "joints": names[o.active].tolist(), "params": {p.name: {"value": v[o.active].tolist(), "unit": p.unit} for p, v in zip(o.law.parameters, o.values)} if not isinstance(o.law, SignalTerm) else {}, "indistinguishable": list(riv), "heldout_gain": c.gain, "p_value": c.p, **o.law.observed(), **({"inputs": list(o.law.inputs)} if isinstance(o.law, SignalTerm) else {})})
    effects.sort(key=lambda e: -e["heldout_gain"])
    terms=[o for o in best.model.applied if isinstance(o.law, SignalTerm)]
    r=R()
    r.report={"joints": list(samples.joints), "effects": effects, "noise_floor": float(noise.mean()),
      "before": {"heldout_mse": mse(b, rep), "per_joint":[mse(b[:,[j]],rep[:,[j]]) for j in range(joints)]},
      "after": {"heldout_mse": mse(a, rep), "per_joint":[mse(a[:,[j]],rep[:,[j]]) for j in range(joints)]},
      "unexplained": {"verdict": "structured" if terms else "white", "depends_on": list(dict.fromkeys(n for o in terms for n in o.law.inputs))},
      "decision": ""}
    return r
