"""What a maintainer runs to prove and to measure armctl: `tools/prove NAME`, `tools/bench NAME`.

A proof counts runs and violations and states its seed; a bench lists rows, armctl's beside others' in the same run.
Each stands in a module of its own with a short form that the test suite calls.
"""
