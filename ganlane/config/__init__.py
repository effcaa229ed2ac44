"""Configuration of the commands: one dataclass per option, its YAML at the same place under conf/."""
