"""`pd-flow`: primal-dual scene flow, brightness and depth constancy with total variation on the surface.

M. Jaimez, M. Souiai, J. Gonzalez-Jimenez, D. Cremers: A Primal-Dual Framework for Real-Time Dense RGB-D Scene Flow,
ICRA 2015. An independent implementation in batched torch for any device; constants and the order of the steps are
those of the authors' published program. The first frame, which carries the result, is the current one; the second is
the previous one. On each of five levels, 15x20 to 240x320:

1. `pyramid`: gray and depth are filtered with a 5x5 binomial kernel, depth within one surface only.
2. `linearise`: derivatives of the second frame, warped once per level by the flow (u, v) of the coarser level. The
   weight of depth is mu = 75 / (1 + 1000 (Z_u^2 + Z_v^2 + Z_t^2)); gray values are 0..255.
3. `primal_dual`: 40, 55, 70, 85, 100 iterations (coarse to fine) of the preconditioned Chambolle-Pock solver with
   theta = 1 on
   sum |I_t + I_u u + I_v v| + mu |Z_t + Z_u u + Z_v v - w| + 0.04 (TV(u) + TV(v)) + 0.35 TV(w), where u and v are
   increments in pixels, w is the total change of depth in metres, and TV is the sum of |r grad f| over the total u, v
   and w, with r = 2 / |step between neighbours on the surface|, so that motion may be discontinuous where the surface
   is. The duals start from those of the coarser level.
4. Increments are clamped to one pixel; `median`: a 3x3 median with weights 1 / (1 + 5 dZ^2 + 10 Z_t^2).

The scene flow in metres is that of a point at (x, y) with depth Z that moves to (x + u, y + v) with depth Z + w.

Differences from the authors' program:

- The frame's intrinsics are used instead of a fixed field of view. Images of any size are resized to 320x240 first,
  and u, v and w are upsampled to the input's pixels within surfaces (`guided_upsampling`).
- Pixel (u, v) of a level is pixel (2u, 2v) of the finer level in the intrinsics as well; their metric on coarse levels
  assumes the principal point at the image centre.
- The product w u is kept, which their linear formula for the lateral flow omits.
- In upsampling, values near the image border are normalised by the weights used; theirs are too large.
- No primal variable is coupled to neighbours beyond the image border, also in the step sizes.
- Depth below 5 mm or above 50 m is ignored.
"""
