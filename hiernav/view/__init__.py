"""A live page in the browser: what the robot knows, plans and does, and ways to meddle. Needs the extra `view`."""
