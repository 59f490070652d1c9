"""Arguments of an algorithm that apply when they are set later, or say that they cannot."""

from __future__ import annotations

from typing import Any, Protocol


class Configurable(Protocol):
    """What has such arguments."""

    #: whether the arguments have been used to build the model
    _is_set_up: bool

    def _reconfigure(self) -> None:
        """Check all arguments, and go on with them."""


class Hyperparameter:
    """An argument that can be set at any time, and applies from the next step on."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, model: Any, owner: type) -> Any:
        if model is None:
            return self
        try:
            return model.__dict__[self.name]
        except KeyError:
            raise AttributeError(f"{owner.__name__} has no {self.name} yet") from None

    def __set__(self, model: Configurable, value: Any) -> None:
        before = model.__dict__.get(self.name)
        model.__dict__[self.name] = value
        if not getattr(model, "_is_set_up", False):
            return
        try:
            model._reconfigure()
        except ValueError:
            model.__dict__[self.name] = before
            model._reconfigure()
            raise


class FixedHyperparameter(Hyperparameter):
    """An argument that the table was built with, and that cannot be set afterwards."""

    def __set__(self, model: Configurable, value: Any) -> None:
        if getattr(model, "_is_set_up", False):
            raise AttributeError(
                f"{self.name} cannot be changed: the table was built with it. Make another model, "
                f"{type(model).__name__}(env, {self.name}={value!r:.100})"
            )
        super().__set__(model, value)
