#!/bin/busybox sh
# First process of the virtual machine: mounts the host's files read-only, runs one command in them
# and says how it ended. Everything written goes to memory.
/bin/busybox --install -s /bin
mkdir -p /proc /sys /dev /host
mount -t proc proc /proc
mount -t sysfs sysfs /sys
mount -t devtmpfs dev /dev
while read -r module; do insmod "/modules/$module" || echo "VM: cannot load $module"; done < /modules/order
mount -t 9p -o trans=virtio,version=9p2000.L,ro,cache=loose,msize=262144 host /host || poweroff -f
mount -t proc proc /host/proc
mount -t sysfs sysfs /host/sys
mount -t devtmpfs dev /host/dev
mkdir -p /host/dev/pts /host/dev/shm
mount -t devpts devpts /host/dev/pts
mount -t tmpfs tmpfs /host/dev/shm
mount -t tmpfs tmpfs /host/mnt
mount -t tmpfs tmpfs /host/run
ifconfig lo 127.0.0.1 up
chroot /host /bin/sh "$(cat /script)"
echo "VM: ended with $?"
sync
poweroff -f
