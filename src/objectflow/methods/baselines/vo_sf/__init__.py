"""`vo-sf`: joint visual odometry and scene flow on geometric clusters.

M. Jaimez, C. Kerl, J. Gonzalez-Jimenez, D. Cremers: Fast Odometry and Scene Flow from RGB-D Cameras based on Geometric
Clustering, ICRA 2017. Written afresh, without any of the authors' code; constants and the order of the steps are those
of their published program. Two frames: the current one is the first, which carries the result, the previous one the
second. In order:

1. `pyramid`: five levels, 15x20 to 240x320, halved without mixing surfaces.
2. `clusters`: k-means of the first frame's points into 24 clusters; those that touch; soft labels
   w_l = exp(-100 |d_own^2 - d_l^2|) of a pixel over its own cluster and those that touch it, divided by their sum.
3. `motions.robust_odometry`: the twist (v, w) of most of the image. With a the vector by which a displacement
   v + w x P changes brightness (a = -grad I dpi/dP) or depth (a = e_z - grad Z dpi/dP), every pixel gives two
   equations a . (v + w x P) + (second - first) = 0 (`linearise`), weighted by depth and, for brightness, by 0.15.
   Their Cauchy penalty sum log(1 + k e^2), k = 16 / mean(|e|)^2, is minimised by reweighted least squares (`solve`).
4. `segment`: a cluster's residual r under that motion, truncated, without edges and occlusions, becomes b from 0
   (static) to 2 (moving): least squares of t_l (b_l - clip((r_l - low) / (high - low), 0, 2)) + prior_l b_l and of
   0.5 (b_l - b_m) over touching clusters; trust t_l is least half way between the two limits, the prior says that what
   is far is static.
5. `motions.cluster_motions`: the camera's motion again from the static clusters, and one motion for each other
   cluster; weights 1 / sqrt(noise + gain |grad|^2), Cauchy with factor 0.25 (camera) and 1 (clusters).
6. `segment` once more; flow = sum_l w_l (T_l - I) P with T_l the inverse motion of cluster l, and that of the
   background for static ones.

What differs from the authors' program, and why:

- Intrinsics are the frame's; theirs are fixed fields of view. Images of any size are worked on at 320x240, and
  clusters, soft labels and flow are then made for every pixel of the input from its own point.
- There is no previous pair: the temporal term of step 4 has weight 0.
- At the coarsest level a second warp is really warped; the program never warps there and would add the same step
  twice.
- A cluster without pixels is left out; there it sits at the camera's centre. A cluster with fewer than six usable
  pixels keeps the motion that it has.
- Holes nearer than 0.3 m are not interpolated over. Depth below 5 mm or above 50 m is not used.
- Moving clusters that touch are reported as one object with the rigid motion nearest to its flow.
"""
