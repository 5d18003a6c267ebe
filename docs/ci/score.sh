# Scores a change of a detector beside the branch that it goes to: bash score.sh COMMIT
set -eu
summary=${GITHUB_STEP_SUMMARY:-summary.md}  # the job's page on GitHub; an artifact on GitLab
old=${1:?which commit the change is compared with}
score() {  # 1 and 4 are verdicts on the detector, which the gate and the JUnit file tell; anything else is a fault
  teatbench score recordings/lab --detector "$1" --out "$2" --summary "$summary" || case $? in 1|4) ;; *) exit 3 ;; esac
}
rm -rf before old new difference summary.md  # of an earlier job in this folder
git worktree prune
git worktree add --quiet --detach before "$old"
score before/detector.toml old
score detector.toml new
teatbench compare old/* new/* --gate --out difference --summary "$summary"
