"""Makes the helpers of this folder (`analytic`) importable from every test, whatever its folder."""
