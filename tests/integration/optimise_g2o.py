"""usage: optimise_g2o.py GRAPH.g2o OPTIMISED.g2o: holds the first pose and
optimises the others with GTSAM. Prints the sums of squared, whitened errors."""

import json
import sys

import gtsam
import numpy


def main(source, target):
    with open(source, encoding="ascii") as file:
        first = file.readline().split()
    spatial = first[0] == "VERTEX_SE3:QUAT"
    graph, initial = gtsam.readG2o(source, spatial)
    # GTSAM does not hold poses: it wants to know how far they may move.
    key = int(first[1])
    if spatial:
        prior = gtsam.noiseModel.Diagonal.Sigmas(numpy.full(6, 1e-6))
        graph.add(gtsam.PriorFactorPose3(key, initial.atPose3(key), prior))
    else:
        prior = gtsam.noiseModel.Diagonal.Sigmas(numpy.full(3, 1e-6))
        graph.add(gtsam.PriorFactorPose2(key, initial.atPose2(key), prior))
    result = gtsam.LevenbergMarquardtOptimizer(graph, initial).optimize()
    gtsam.writeG2o(graph, result, target)
    print(json.dumps({"before": 2.0 * graph.error(initial),
                      "after": 2.0 * graph.error(result)}))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
