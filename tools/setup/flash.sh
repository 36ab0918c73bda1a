#!/bin/sh
# Write build/TARGET/selfcal into a module: flash.sh TARGET (make flash TARGET=...), by the first writer of
# port/boards.txt that is there. With SENSOR=... it is build/TARGET-SENSOR/selfcal.
# FLASHER names a writer; OPENOCD_INTERFACE is openocd's file for the probe.
set -u
target=$1

boards='' known='' interface='' chip=''
while read -r board core clock report part probe writers; do
    case $board in '' | \#*) continue ;; esac
    boards="$boards $board"
    if [ "$board" = "$target" ]; then
        known=$writers
        interface=${OPENOCD_INTERFACE:-$probe}
        chip=$part
    fi
done <port/boards.txt
if [ -z "$known" ]; then
    echo "make flash TARGET=..., one of:$boards" >&2
    exit 2
fi
IFS=, && set -- $known && IFS=' '
known="$*"

flasher=
for name in ${FLASHER:-$known}; do
    case " $known " in *" $name "*) ;; *) continue ;; esac
    if command -v "$name" >/dev/null; then
        flasher=$name
        break
    fi
done
if [ -z "$flasher" ]; then
    echo "make flash: none of these is installed: ${FLASHER:-$known} (packages openocd, stlink-tools, dfu-util)" >&2
    exit 1
fi

make --no-print-directory firmware || exit 1
folder=build/$target
case ${SENSOR:-adis16405} in adis16405) ;; *) folder=$folder-$SENSOR ;; esac
image=$folder/selfcal
flags=$(sed 's/APP_COMMAND_KEY=[^ ]*/APP_COMMAND_KEY=.../; s/^ *\(.\)/ \1/' "$folder/flags" 2>/dev/null)
echo "$flasher writes $image$flags"
case $flasher in
openocd) exec openocd -f "$interface" -f "$chip" -c "program $image.elf verify reset exit" ;;
st-flash) exec st-flash --reset write "$image.bin" 0x08000000 ;;
dfu-util) exec dfu-util -a 0 -s 0x08000000:leave -D "$image.bin" ;; # with BOOT0 high at reset: the ROM's boot loader
esac
