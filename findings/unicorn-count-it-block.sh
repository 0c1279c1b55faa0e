#!/usr/bin/env bash
# Unicorn 2.1.4: `emu_start(count=n)` executes more than n instructions if it reaches a Thumb IT block.
#
# The count is checked between instructions, but not inside an IT block. `count=3` executes `movs`, `cmp`, `it` and
# the four conditional instructions behind it. Counts from 3 to 7 end at the same place. A bench that steps a Cortex-M
# firmware by one instruction, or that counts the steps of a control period by `count`, counts too few. If the
# condition is false, the code hook gets only `it`: the skipped instructions, which take a cycle each on the device,
# are not reported.
#
# Output seen (movs, cmp, itttt eq, four moves, nop):
#   count=2: 2 instructions, ends at 0x1004
#   count=3: 7 instructions, ends at 0x100e
#   count=7: 7 instructions, ends at 0x100e
#   count=8: 8 instructions, ends at 0x1010
#   condition false: 4 instructions of 8 reported, ends at 0x1010
#
# What to do: count in a `UC_HOOK_CODE` hook, and decode `it` there to add the skipped instructions.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check unicorn==2.1.4
cd "$folder"
venv/bin/python - >output <<'PYTHON'
from unicorn import UC_ARCH_ARM, UC_HOOK_CODE, UC_MODE_MCLASS, UC_MODE_THUMB, Uc
from unicorn.arm_const import UC_ARM_REG_PC


def executed(compared, count):
    # movs r0, #1; cmp r0, #compared; itttt eq; moveq r1, #1; moveq r2, #2; moveq r3, #3; moveq r4, #4; nop
    code = bytes([0x01, 0x20, compared, 0x28]) + bytes.fromhex("01bf 0121 0222 0323 0424 00bf")
    emulator, addresses = Uc(UC_ARCH_ARM, UC_MODE_THUMB | UC_MODE_MCLASS), []
    emulator.mem_map(0x1000, 0x1000)
    emulator.mem_write(0x1000, code)
    emulator.hook_add(UC_HOOK_CODE, lambda _, address, size, data: addresses.append(address))
    emulator.emu_start(0x1001, 0x1000 + len(code), count=count)
    return len(addresses), hex(emulator.reg_read(UC_ARM_REG_PC))


for count in (2, 3, 7, 8):
    number, end = executed(1, count)
    print(f"count={count}: {number} instructions, ends at {end}")
number, end = executed(2, 0)
print(f"condition false: {number} instructions of 8 reported, ends at {end}")
PYTHON
cat output
diff output - <<'EXPECTED'
count=2: 2 instructions, ends at 0x1004
count=3: 7 instructions, ends at 0x100e
count=7: 7 instructions, ends at 0x100e
count=8: 8 instructions, ends at 0x1010
condition false: 4 instructions of 8 reported, ends at 0x1010
EXPECTED
