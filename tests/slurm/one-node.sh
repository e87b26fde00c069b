#!/usr/bin/env bash
# A Slurm of one node, for tests: one-node.sh start FOLDER, one-node.sh stop FOLDER. As root, from
# Debian's packages slurmctld, slurmd, slurm-client and slurm-wlm-basic-plugins; FOLDER takes its
# state and logs. Jobs that another job submits lose SLURM_CONF, so the configuration has to be in
# its usual place; one that is there and is not ours is left alone.
set -euo pipefail
action=$1 folder=$2
conf=/etc/slurm/slurm.conf
mark='# Written by vorolight for its tests.'

stop() {
    for name in slurmd slurmctld; do
        [ ! -f "$folder/$name.pid" ] || kill "$(cat "$folder/$name.pid")" 2> /dev/null || true
    done
    for _ in $(seq 100); do
        pgrep -F "$folder/slurmctld.pid" > /dev/null 2>&1 || break
        sleep 0.1
    done
    if grep -qsF "$mark" "$conf"; then rm "$conf"; fi
}

start() {
    for name in slurmctld slurmd; do
        command -v "$name" > /dev/null || { echo "$name is not installed" >&2; exit 69; }
    done
    if [ -e "$conf" ] && ! grep -qF "$mark" "$conf"; then
        echo "$conf is of another Slurm" >&2
        exit 75
    fi
    memory=$(awk '/^MemTotal/ {print $2}' /proc/meminfo) # kB
    mkdir -p "$folder/state" "$folder/spool" /etc/slurm
    cat > "$conf" << END
$mark
ClusterName=one
SlurmctldHost=$(hostname -s)(127.0.0.1)
SlurmUser=root
AuthType=auth/none
AuthInfo=cred_expire=10
CredType=cred/none
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SchedulerParameters=sched_interval=1,bf_interval=1,sched_min_interval=0
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
MpiDefault=none
ReturnToService=2
KillWait=5
MaxArraySize=1001
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool
SlurmctldPidFile=$folder/slurmctld.pid
SlurmdPidFile=$folder/slurmd.pid
SlurmctldLogFile=$folder/slurmctld.log
SlurmdLogFile=$folder/slurmd.log
NodeName=$(hostname -s) NodeAddr=127.0.0.1 CPUs=$(nproc) RealMemory=$((memory / 1024)) State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
END
    slurmctld -c
    slurmd
    for _ in $(seq 60); do
        ! sinfo --noheader -o %t 2> /dev/null | grep -q idle || exit 0
        sleep 0.5
    done
    echo "no node came up; see $folder" >&2
    exit 1
}

case $action in
    start) start ;;
    stop) stop ;;
    *) echo "start or stop" >&2; exit 2 ;;
esac
