"""Moving objects, rigid motions and dense scene flow from two RGB-D frames."""
