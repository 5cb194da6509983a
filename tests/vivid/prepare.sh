#!/bin/sh
# Builds what tests/sources/test_v4l2_vivid.py boots: a Debian kernel with the `vivid` test cameras, and an initramfs.
# The kernel package is unpacked into a cache folder, never installed. Safe to call again: it then only
# renews the initramfs. Needs Debian's apt; missing tools are installed when run as root.
set -eu

here=$(cd "$(dirname "$0")" && pwd)
cache=${SAGS_VIVID_CACHE:-${XDG_CACHE_HOME:-$HOME/.cache}/sags-vivid}

if [ "$(id -u)" = 0 ]; then
    for pair in qemu-system-x86_64:qemu-system-x86 busybox:busybox-static; do
        command -v "${pair%%:*}" >/dev/null || DEBIAN_FRONTEND=noninteractive \
            apt-get install -y -q --no-install-recommends "${pair##*:}"
    done
fi
for tool in qemu-system-x86_64 busybox; do
    command -v "$tool" >/dev/null || { echo "prepare.sh: $tool is missing; run as root once" >&2; exit 1; }
done

mkdir -p "$cache"
if [ ! -f "$cache/vmlinuz" ] || [ ! -d "$cache/root/lib/modules" ]; then
    package=$(apt-cache depends linux-image-amd64 | sed -n 's/^ *Depends: \(linux-image-[0-9].*\)$/\1/p' | head -n 1)
    [ -n "$package" ] || { echo "prepare.sh: no linux-image package known; run apt-get update" >&2; exit 1; }
    release=${package#linux-image-}
    work=$(mktemp -d "$cache/unpack.XXXXXX")
    trap 'rm -rf "$work"' EXIT
    (cd "$work" && apt-get download -q "$package" && dpkg-deb -x ./*.deb tree)
    busybox depmod -b "$work/tree" "$release"

    # Only the modules the guest loads, each with its dependencies (modules.dep lists all of them).
    modules=lib/modules/$release
    rm -rf "$cache/root"
    mkdir -p "$cache/root/$modules"
    cp "$work/tree/$modules/modules.dep" "$cache/root/$modules/"
    grep -E '/(virtio_pci|9pnet_virtio|9p|vivid)\.ko:' "$work/tree/$modules/modules.dep" | tr -d ':' | tr ' ' '\n' |
        sort -u | while read -r module; do
            mkdir -p "$cache/root/$modules/$(dirname "$module")"
            cp "$work/tree/$modules/$module" "$cache/root/$modules/$module"
        done
    [ -f "$cache/root/$modules/kernel/drivers/media/test-drivers/vivid/vivid.ko" ] ||
        { echo "prepare.sh: $package holds no uncompressed vivid module" >&2; exit 1; }
    cp "$work/tree/boot/vmlinuz-$release" "$cache/vmlinuz"
fi

mkdir -p "$cache/root/bin" "$cache/root/proc" "$cache/root/sys" "$cache/root/dev" "$cache/root/host"
cp "$(command -v busybox)" "$cache/root/bin/busybox"
cp "$here/init" "$cache/root/init"
chmod +x "$cache/root/init"
(cd "$cache/root" && busybox find . | busybox cpio -o -H newc 2>/dev/null | gzip -1) >"$cache/initramfs.gz"
echo "vivid guest ready in $cache"
