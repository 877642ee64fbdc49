"""Groups that decide which callbacks may run at the same time."""

from __future__ import annotations

from abc import ABC, abstractmethod
from threading import Lock
from typing import Any
from weakref import WeakSet


class CallbackGroup(ABC):
    def __init__(self) -> None:
        self._entities: WeakSet[Any] = WeakSet()
        self._lock = Lock()

    @property
    def entities(self) -> WeakSet[Any]:
        return self._entities

    def add_entity(self, entity: Any) -> None:
        self._entities.add(entity)

    def has_entity(self, entity: Any) -> bool:
        return entity in self._entities

    @abstractmethod
    def can_execute(self, entity: Any) -> bool:
        """Whether a callback of the entity may begin now."""

    @abstractmethod
    def beginning_execution(self, entity: Any) -> bool:
        """Reserve the group for a callback of the entity; False if it may not begin."""

    @abstractmethod
    def ending_execution(self, entity: Any) -> None:
        """Give back what `beginning_execution` reserved."""


class ReentrantCallbackGroup(CallbackGroup):
    """Callbacks run side by side without limit."""

    def __init__(self) -> None:
        super().__init__()

    def can_execute(self, entity: Any) -> bool:
        return True

    def beginning_execution(self, entity: Any) -> bool:
        return True

    def ending_execution(self, entity: Any) -> None:
        """Nothing was reserved."""


class MutuallyExclusiveCallbackGroup(CallbackGroup):
    """One callback at a time."""

    def __init__(self) -> None:
        super().__init__()
        self._active: Any = None

    def can_execute(self, entity: Any) -> bool:
        return self._active is None

    def beginning_execution(self, entity: Any) -> bool:
        with self._lock:
            if self._active is not None:
                return False
            self._active = entity
            return True

    def ending_execution(self, entity: Any) -> None:
        with self._lock:
            self._active = None
