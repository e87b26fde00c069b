"""The figures in the paper, by table. CD^2 is multiplied by 1e3."""

from __future__ import annotations

# Table 1: mean, standard deviation, median and 95th percentile of |H|, SDF loss.
FIELDS = {
    ("cube-cavity", "before"): (10.5274, 9.927, 7.3243, 25.3509, 0.0055),
    ("cube-cavity", "after"): (1.6657, 4.4819, 0.0141, 7.5055, 0.0002),
    ("heart", "before"): (4.4406, 3.2158, 4.119, 10.2855, 0.0091),
    ("heart", "after"): (1.4836, 0.8593, 1.3428, 2.5150, 0.0013),
}
# Table 2 and the ablation of faces, ten meshes of Thingi10K: mean and standard deviation of CD^2
# and F1 and mean |H|, median and 95th percentile of |H|. (The ablation's table repeats VoroMesh's
# median, 19.0778, in the row of polygons; that of Table 2 is here.)
MESHES = {
    "polygon": ((0.053, 0.027), (0.9575, 0.0293), (14.3868, 14.5309), 10.4958, 47.13),
    "triangle": ((0.048, 0.029), (0.96, 0.035), (10.9633, 8.6093), 8.3130, 31.9124),
    "baseline": ((0.015, 0.005), (0.9996, 0.0007), (26.9990, 21.4034), 19.0778, 74.0999),
}
# Twelve textured objects, by number of views: mean, standard deviation and median of CD^2 and F1.
VIEWS = {
    300: ((0.289, 0.276, 0.180), (0.783, 0.139, 0.809)),
    6: ((1.981, 2.312, 1.199), (0.487, 0.168, 0.555)),
}
NOISE = (0.0, 0.1, 0.5, 1.0, 2.0)
"""Standard deviations of the noise, in percent of the diagonal."""
RESOLUTIONS = (15, 25, 40, 60)
INNER = (200, 800, 3200)
