#!/bin/busybox sh
# The guest's first process. The root becomes the host's files, read only, under a layer of memory; the results folder
# is the only place of the host that the guest may write. Then the agent takes over as process 1: when it ends, the
# kernel panics and QEMU leaves.
/bin/busybox mount -t proc proc /proc
/bin/busybox --install -s /bin
export PATH=/bin
. /settings

for module in /modules/*.ko; do
    insmod "$module"
done

options=trans=virtio,version=9p2000.L,msize=1048576
mount -t 9p -o "ro,cache=loose,$options" host /host
mount -t tmpfs upper /upper
mkdir /upper/changes /upper/work
mount -t overlay -o lowerdir=/host,upperdir=/upper/changes,workdir=/upper/work root /root

mkdir -p /root/proc /root/sys /root/dev /root/run /root/evstim-results
mount -t proc proc /root/proc
mount -t sysfs sys /root/sys
mount -t devtmpfs dev /root/dev
mkdir -p /root/dev/shm
mount -t tmpfs shm /root/dev/shm
mount -t tmpfs run /root/run
mount -t 9p -o "$options" results /root/evstim-results

# QEMU's user network: the guest is 10.0.2.15, the host's loopback interface appears as 10.0.2.2.
ip link set lo up
ip link set eth0 up
ip addr add 10.0.2.15/24 dev eth0

umount /proc
exec switch_root /root /usr/bin/env -i PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin \
    HOME=/root PYTHONDONTWRITEBYTECODE=1 "$PYTHON" "$AGENT" 10.0.2.2 "$PORT" pathlib
