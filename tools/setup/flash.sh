#!/bin/sh
# Write build/TARGET/selfcal into a module: flash.sh TARGET KNOWN... (make flash TARGET=...), by the first that is there of openocd,
# st-flash and dfu-util. FLASHER names one of them; OPENOCD_INTERFACE is openocd's file for the probe.
set -u
target=$1
shift
case " $* " in
*" $target "*) ;;
*)
    echo "make flash TARGET=..., one of: $*" >&2
    exit 2
    ;;
esac

case $target in
stm32f405)
    known="openocd st-flash dfu-util"
    interface=${OPENOCD_INTERFACE:-interface/stlink.cfg}
    chip=target/stm32f4x.cfg
    ;;
*)
    known=openocd
    interface=${OPENOCD_INTERFACE:-interface/cmsis-dap.cfg}
    chip=target/nrf51.cfg
    ;;
esac

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
image=build/$target/selfcal
echo "$flasher writes $image$(sed 's/APP_COMMAND_KEY=[^ ]*/APP_COMMAND_KEY=.../; s/^ *\(.\)/ \1/' "build/$target/flags" 2>/dev/null)"
case $flasher in
openocd) exec openocd -f "$interface" -f "$chip" -c "program $image.elf verify reset exit" ;;
st-flash) exec st-flash --reset write "$image.bin" 0x08000000 ;;
dfu-util) exec dfu-util -a 0 -s 0x08000000:leave -D "$image.bin" ;; # with BOOT0 high at reset: the ROM's boot loader
esac
