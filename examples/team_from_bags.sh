#!/bin/sh
# A team's bags to one map: sh examples/team_from_bags.sh BAGS OUT
# BAGS is a folder with a bag per robot, each named after its robot, or one bag of several robots.
set -eu
bags=${1:?"a folder with a bag per robot, or one bag"}
out=${2:?"a folder for the run"}
flocc dataset info "$bags"             # what is in them, and what is not taken
flocc simulate "$bags" --out "$out"    # on virtual time; `flocc launch` takes the same and runs a process per robot
flocc evaluate "$out" --quiet
flocc doctor "$out"                    # why the maps merged, or not
