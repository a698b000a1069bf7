#!/bin/bash
# A sweep on a Slurm cluster, from the folder of the repository, which all nodes must see:
#
#   sbatch [--partition=P --account=A] docs/slurm/sweep.sh EXPERIMENT PIECES KEY=A,B ...
#   sbatch docs/slurm/sweep.sh beam_paper 16 tignn.form=node tignn.passes=4,8 tignn.lambda_d=5,50 training.noise=3e-3,3e-2
#
# The job of this script only waits and hands out others: PIECES jobs that simulate, then one per point of the sweep, each
# a task of a job array (at most BATCH tasks in one). Give it again after whatever happened: what is finished is reused.
#
# LAUNCH: options of the launcher (conf/hydra/launcher/slurm.yaml), as words: LAUNCH="slurm.partition=cpu mem_gb=8".
# OUTPUTS: folder of all results. BATCH: the cluster's MaxArraySize - 1. ZSDT: how the program is started.
#SBATCH --job-name=zsdt-sweep
#SBATCH --cpus-per-task=1
#SBATCH --mem=4G
#SBATCH --time=2-00:00:00
set -euo pipefail
experiment=${1:?name of an experiment, such as beam_laptop}
pieces=${2:?pieces in which the data are made, 1 for one}
shift 2
read -r -a zsdt <<<"${ZSDT:-.venv/bin/python -m pipelines}"
read -r -a words <<<"${LAUNCH:-}"
common=("experiment=$experiment" "machine.outputs=${OUTPUTS:-outputs}" machine.workers=1)
array=(-m hydra/launcher=slurm "hydra.sweeper.max_batch_size=${BATCH:-1000}")
for word in ${words[@]+"${words[@]}"}; do array+=("hydra.launcher.$word"); done
for name in "${!SLURM_@}"; do unset "$name"; done # this job's own limits are not those of the others

if ((pieces > 1)); then
  names=$(seq -s, -f "%g/$pieces" 1 "$pieces")
  "${zsdt[@]}" "${array[@]}" "${common[@]}" "stages=[synthesize_shard]" "shard=$names"
  "${zsdt[@]}" "${common[@]}" "stages=[synthesize]" "machine.shards=$pieces"
fi
"${zsdt[@]}" "${array[@]}" "${common[@]}" "$@"
