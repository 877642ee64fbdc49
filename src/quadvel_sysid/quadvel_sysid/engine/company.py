"""What the laws of a model become beside each other: their forms and joints, which of them stay, and which give way.

Each came in when it took most off the error, before those after it were known.
"""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import numpy as np

from quadvel_actuator.effects import EffectLaw, registry

from .ahead import side_by_side
from .candidates import About, Candidate, Rest, best_form, judged, less_said
from .delays import fit_with_delays
from .few import Few, remembers
from .judging import Comparison, Judge
from .model import Model
from .ranking import LEVEL, SIMPLER_LOSES, TIES, WORTH, choice, worth
from .signals import Array, Bools
from .valleys import deepest

_BETTER_FORM = 0.99
"""of the held-out error, that another form of a law has to leave at most"""

_PROMISING = 0.25
"""Of what a law takes off the error: a rival that promises less is not fitted."""

_OF_UNSAID = 0.1
"""Of what a model leaves above the noise: an effect worth less stands in for what no effect says."""


@attrs.frozen
class Said:
    """Of a law when it came: the names of those that said it as well, and of those that were nearly as good."""

    ties: tuple[str, ...] = ()
    rivals: tuple[str, ...] = ()


def with_kin(model: Model, said: Sequence[Said]) -> list[Said]:
    """With rivals that may not have come near at the time: laws of the same signal, or that look like a delay, too.

    Several laws may have come one after the other for one that was hidden.
    """

    def kin(law: EffectLaw) -> tuple[str, ...]:
        near = {n for n, o in registry().items() if o.signal == law.signal or (o.shifts and law.shifts)}
        return tuple(near - {law.name})

    return [
        attrs.evolve(of_it, rivals=(*of_it.rivals, *kin(one.law)))
        for one, of_it in zip(model.applied, said, strict=True)
    ]


@attrs.frozen(eq=False)
class Company:
    """Puts the laws of a model right; `noise` (J,) is the floor of each joint, N^2 m^2, `few` the rows to fit to.

    `cores` share the work.

    What was said of the laws goes with a model, in their order.
    """

    judge: Judge
    noise: Array
    few: Few
    cores: int = 1

    def taken(self, about: About, best: Candidate) -> Model:
        """The candidate's model fitted from other delays, all laws in the forms and on the joints that suit each other."""
        found = about.fit_anew(best.model.holding(False))
        if not remembers(found):  # whose fits take long: in the end, once
            found = self.few.fitted(found, self._deepest, 1)
        found = self._reformed(fit_with_delays(found, self.judge.fit))
        return self.released(self.widened(found))

    def exchanged(self, model: Model, said: Sequence[Said]) -> tuple[Model, list[Said]]:
        """With laws exchanged for rivals that say more beside the others, or as much and are simpler.

        Laws that came after those that something is said of stay.
        """
        said = list(said)
        k = 0
        while k < len(said):
            change = self._exchange(model, k, said[k].rivals)
            if change is None:
                k += 1
                continue
            about, best, ties = change
            new = self.taken(about, best)
            *others, last = new.applied
            model = attrs.evolve(new, applied=(*others[:k], last, *others[k:]))
            said[k] = Said(ties, tuple(name for name in said[k].rivals if name != best.name))
            k = 0
        return model, said

    def _exchange(
        self, model: Model, index: int, rivals: Sequence[str]
    ) -> tuple[About, Candidate, tuple[str, ...]] | None:
        """The rival that says it better than the law at `index`, on top of what, and which say it as well; None if none."""
        one, less = model.applied[index], model.without(index)
        taken = {other.law.name for other in model.applied}
        named = [law for name, law in registry().items() if name in rivals and name not in taken]
        if not named or not less.applied:
            return None
        beside = About(self._fitted(less, 5), self.judge, self.noise, self.few, self.cores)
        now = judged(beside, one.law, less.plus(one))
        least = _PROMISING * beside.kept(now)
        others = side_by_side(
            lambda k: best_form(beside, named[k], least), len(named), self.cores, beside.samples
        )
        found = [now, *filter(None, others)]
        best, ties = choice(sorted(found, key=lambda each: -each.gain), self.judge, self.noise)
        more = len(best.law.parameters) - len(one.law.parameters)
        gained = self.judge.compare(now.residual, best.residual)
        clear = gained.p_any * len(found) < LEVEL
        pays = gained.gain > more * SIMPLER_LOSES * float(self.noise.mean())
        return (beside, best, ties) if best is not now and (more < 0 or (clear and pays)) else None

    def _reformed(self, model: Model) -> Model:
        """With those forms of its laws that suit each other best."""
        for index, one in enumerate(model.applied):
            for form in one.law.forms_beside(Rest(model.without(index), self.judge.fit)):
                other = self._fitted(model.replacing(index, one.formed(form)), 10)
                if other.error(self.judge.judge) < _BETTER_FORM * model.error(self.judge.judge):
                    model = other
        return model

    def widened(self, model: Model) -> Model:
        """With each effect also on joints that show it only now, as what came later hid it there."""
        for k, one in enumerate(model.applied[:-1]):
            if one.active.all() or one.law.gainlike:
                continue
            usual = one.values[:, one.active].mean(axis=1, keepdims=True)
            everywhere = attrs.evolve(
                one, active=np.ones_like(one.active), values=np.where(one.active, one.values, usual)
            )
            tried = self._fitted(model.replacing(k, everywhere), 5)
            found = self._compared(model, tried)
            clear = (found.p_joints * len(registry()) < LEVEL) & (found.joint_gain > WORTH * self.noise)
            if (clear & ~one.active).any():
                wider = attrs.evolve(tried.applied[k], active=one.active | clear)
                model = self._fitted(tried.replacing(k, wider), 5)
        return model

    def released(self, model: Model) -> Model:
        """With gains that are held left free, if they then stay near those commanded."""
        if not model.gains_held:
            return model
        free = self._fitted(attrs.evolve(model, gains_held=False), 10)
        return free if free.believable else model

    def pruned(self, model: Model, said: Sequence[Said]) -> tuple[Model, list[Said]]:
        """Without the effects that the later ones made needless, and fitted once more with the delays."""
        model, said, _ = self.needed(model, said)
        return (fit_with_delays(model, self.judge.fit) if model.applied else model), said

    def needed(self, model: Model, said: Sequence[Said]) -> tuple[Model, list[Said], list[Comparison]]:
        """Without the effects that are not worth it beside the others, and what leaving out each of the rest costs."""
        said = list(said)
        while True:
            losses = [self._loss(model, k) for k in range(len(model.applied))]
            idle = [k for k, (loss, _) in enumerate(losses) if not self._pays(model, k, loss)]
            if not idle:
                return model, said, [loss for loss, _ in losses]
            worst = min(idle, key=lambda k: losses[k][0].gain)
            model = losses[worst][1]
            del said[worst]

    def _pays(self, model: Model, index: int, loss: Comparison) -> bool:
        share = worth(loss.joint_gain, model.applied[index].active, self._least(model))
        return bool(loss.p_any * len(registry()) < LEVEL and share > 1.0)

    def _least(self, model: Model) -> Array:
        """What an effect of this model has to be worth on a joint, N^2 m^2 (J,)."""
        rows = self.judge.judge
        left = np.where(rows, model.samples.tau - model.predict(), 0.0)
        above = np.sum(left**2, axis=0) / np.maximum(rows.sum(axis=0), 1) - self.noise
        return np.maximum(WORTH * self.noise, _OF_UNSAID * above)

    def simplest(self, model: Model, said: Sequence[Said]) -> tuple[Model, list[Said]]:
        """With simpler laws where these say as much: what came later may have been why the other law was needed."""
        said = list(said)
        for k, one in enumerate(model.applied):
            less = less_said(one)
            if less is None or any(other.law.name == less.law.name for other in model.applied):
                continue
            tried = fit_with_delays(model.replacing(k, less), self.judge.fit)
            if self._compared(tried, model).gain < SIMPLER_LOSES * float(self.noise.mean()):
                model = tried
                ties = (one.law.name, *(name for name in said[k].ties if name != less.law.name))[:TIES]
                said[k] = attrs.evolve(said[k], ties=ties)
        return model, said

    def narrowed(self, model: Model) -> Model:
        """With each effect off joints that need it no more, the weakest ones first.

        What an effect bends before all of it is found, gains or delays of every joint, it can seem to mend on any of them.
        """
        for k in range(len(model.applied)):
            while model.applied[k].active.sum() > 1:
                one = model.applied[k]
                acts = np.where(self.judge.fit, model.predict() - model.without(k).predict(), 0.0)
                share = np.mean(acts**2, axis=0) / self.noise
                weakest = int(np.argmin(np.where(one.active, share, np.inf)))
                fewer = attrs.evolve(one, active=one.active & (np.arange(len(share)) != weakest))
                tried = self._fitted(model.replacing(k, fewer), 10)
                lost = self._compared(tried, model)
                least = WORTH * self.noise[weakest] / len(share)
                if lost.p_any * len(registry()) < LEVEL and lost.gain > least:
                    break
                model = tried
        return model

    def deepened(self, model: Model) -> Model:
        """At the bottom of its deepest valley; with a memory, as few rows show it, since all would take long."""
        if remembers(model):
            return fit_with_delays(self.few.fitted(model, self._deepest, 1), self.judge.fit)
        return self._deepest(model, self.judge.fit, 4)

    def _deepest(self, model: Model, rows: Bools, rounds: int) -> Model:
        return deepest(model, rows, rounds, self.cores)

    def _loss(self, model: Model, index: int) -> tuple[Comparison, Model]:
        """What leaving an effect out costs on held-out rows, and the model without it."""
        less = self._fitted(model.without(index), 5)
        return self._compared(less, model), less

    def _fitted(self, model: Model, steps: int) -> Model:
        return self.few.fitted(model, fit_with_delays, steps)

    def _compared(self, before: Model, after: Model) -> Comparison:
        tau = before.samples.tau
        return self.judge.compare(tau - before.predict(), tau - after.predict())
