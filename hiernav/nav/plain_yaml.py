"""YAML that can be trusted to be as small and as plain as it looks."""

from __future__ import annotations

from typing import Any

import yaml


class PlainLoader(yaml.SafeLoader):
    """Refuses aliases, of which a few lines stand for values of any size, and tags, which choose what text becomes.

    PyYAML's own constructors of tagged values fail with whatever Python raises, without a place.
    """

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event = self.peek_event()
        if isinstance(event, yaml.AliasEvent):
            raise yaml.composer.ComposerError(problem="aliases are not accepted", problem_mark=event.start_mark)
        if (tag := event.tag) is not None:
            shown = tag.replace("tag:yaml.org,2002:", "!!")[:40]
            raise yaml.composer.ComposerError(
                problem=f"tags are not accepted: {shown!r}", problem_mark=event.start_mark
            )
        return super().compose_node(parent, index)
