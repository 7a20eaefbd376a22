"""`vo-sf`: joint visual odometry and scene flow on geometric clusters.

M. Jaimez, C. Kerl, J. Gonzalez-Jimenez, D. Cremers: Fast Odometry and Scene Flow from RGB-D Cameras based on Geometric
Clustering, ICRA 2017. An independent implementation; constants and the order of the steps are those of the authors'
published program. The first frame, which carries the result, is the current one; the second is the previous one:

1. `pyramid`: five levels, 15x20 to 240x320, halved without mixing surfaces.
2. `clusters`: k-means of the first frame's points into 24 clusters, the connectivity of the clusters, and soft labels
   w_l = exp(-100 |d_own^2 - d_l^2|) of a pixel over its own and the connected clusters, normalised to sum 1.
3. `motions.robust_odometry`: the twist (v, w) of most of the image. With a the gradient of brightness
   (a = -grad I dpi/dP) or depth (a = e_z - grad Z dpi/dP) with respect to a displacement v + w x P, every pixel gives
   two equations a . (v + w x P) + (second - first) = 0 (`linearise`), weighted by depth and, for brightness, by 0.15.
   Their Cauchy loss sum log(1 + k e^2), k = 16 / mean(|e|)^2, is minimised by reweighted least squares (`solve`).
4. `segment`: a cluster's truncated residual r under that motion, without edges and occlusions, gives b from 0 (static)
   to 2 (moving): least squares of t_l (b_l - clip((r_l - low) / (high - low), 0, 2)) + prior_l b_l and of
   0.5 (b_l - b_m) over connected clusters; the confidence t_l is smallest midway between the two limits, and the
   prior favours static for distant clusters.
5. `motions.cluster_motions`: the camera's motion again from the static clusters, and one motion for each other
   cluster; weights 1 / sqrt(noise + gain |grad|^2), Cauchy with factor 0.25 (camera) and 1 (clusters).
6. `segment` again; flow = sum_l w_l (T_l - I) P with T_l the inverse motion of cluster l, or that of the background
   for static clusters.

Differences from the authors' program:

- The frame's intrinsics are used instead of a fixed field of view. Images of any size are processed at 320x240;
  clusters, soft labels and flow are then computed for every pixel of the input from its point.
- There is no previous pair, so the temporal term of step 4 has weight 0.
- At the coarsest level the second iteration warps the frame; the program does not warp there and would add the same
  step twice.
- A cluster without pixels is excluded; in the program it lies at the camera's centre. A cluster with fewer than six
  usable pixels keeps its motion.
- Holes nearer than 0.3 m are not interpolated over. Depth below 5 mm or above 50 m is ignored.
- Connected moving clusters are reported as one object with the rigid motion closest to its flow.
"""
