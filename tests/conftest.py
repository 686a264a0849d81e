from hypothesis import settings

settings.register_profile(
    "estbench", derandomize=True, max_examples=50, deadline=None, database=None
)
settings.load_profile("estbench")
