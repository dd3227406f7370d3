"""The numpy core that a trained robot and a deployed robot share: maps, plans, options and observations."""
