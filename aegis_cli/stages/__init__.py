"""One file a stage: `run(..., on_event) -> Report`; a stage never prints, prompts or exits."""
