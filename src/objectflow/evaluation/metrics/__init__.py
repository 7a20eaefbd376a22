"""How well a result fits the truth: flow, masks, objects, movers, borders."""
