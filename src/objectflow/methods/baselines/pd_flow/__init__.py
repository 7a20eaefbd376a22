"""`pd-flow`: primal-dual scene flow, brightness and depth constancy with total variation on the surface.

M. Jaimez, M. Souiai, J. Gonzalez-Jimenez, D. Cremers: A Primal-Dual Framework for Real-Time Dense RGB-D Scene Flow,
ICRA 2015. Written afresh in batched torch, for any device, without any of the authors' code; constants and the order
of the steps are those of their published program. The current frame is the first, which carries the result, the
previous one the second. On each of five levels, 15x20 to 240x320:

1. `pyramid`: gray and depth by a 5x5 binomial mask, depth on one surface only.
2. `linearise`: derivatives of the second frame, sampled where the flow (u, v) of the coarser level leads, one warp a
   level. Weight of depth mu = 75 / (1 + 1000 (Z_u^2 + Z_v^2 + Z_t^2)); gray from 0 to 255.
3. `primal_dual`: 40, 55, 70, 85, 100 iterations (coarse to fine) of the preconditioned Chambolle-Pock solver,
   theta = 1, on
   sum |I_t + I_u u + I_v v| + mu |Z_t + Z_u u + Z_v v - w| + 0.04 (TV(u) + TV(v)) + 0.35 TV(w), where u and v are
   increments in pixels, w the whole change of depth in metres, and TV the sum of |r grad f| over the whole u, v and w,
   r = 2 / |step between neighbours on the surface|: motion may jump where the surface does. The duals of the coarser
   level are the start.
4. Increments are cut off at one pixel; `median`: a 3x3 median with weights 1 / (1 + 5 dZ^2 + 10 Z_t^2).

The flow in metres is that of a point seen at (x, y) with depth Z that goes to (x + u, y + v) with depth Z + w.

What differs from the authors' program, and why:

- Intrinsics are the frame's; theirs are a fixed field of view. Images of any size are reduced to 320x240 first, theirs
  by the pyramid's mask; u, v and w are then carried to the input's pixels within surfaces (`enlarge`).
- A level's pixel (u, v) is (2u, 2v) of the finer level, in its intrinsics too; there the metric of coarse levels takes
  the image's centre for the principal point.
- The product w u, which their linear formula for the sideways flow leaves out, is kept.
- Going up a level, values near the image border are divided by the weights that were used; theirs come out too large.
- No primal variable is coupled to neighbours beyond the image border, in the step sizes too.
- Depth below 5 mm or above 50 m is not used.
"""
