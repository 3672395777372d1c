"""The paper's tables and figures and what goes beyond them: one file a study, run by its script and by `reproduce`."""
