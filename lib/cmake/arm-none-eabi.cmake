# Toolchain file for Cortex-M: cmake -DCMAKE_TOOLCHAIN_FILE=.../arm-none-eabi.cmake [-DSELFCAL_CPU=cortex-m0]
# SELFCAL_CPU: cortex-m0, cortex-m0plus, cortex-m3, cortex-m4 (default), cortex-m7 or cortex-m33.
set(CMAKE_SYSTEM_NAME Generic)
set(CMAKE_SYSTEM_PROCESSOR arm)
set(CMAKE_C_COMPILER arm-none-eabi-gcc)
set(CMAKE_CXX_COMPILER arm-none-eabi-g++)
# CMake's trial programs have no board to link for.
set(CMAKE_TRY_COMPILE_TARGET_TYPE STATIC_LIBRARY)
list(APPEND CMAKE_TRY_COMPILE_PLATFORM_VARIABLES SELFCAL_CPU)

set(SELFCAL_CPU cortex-m4 CACHE STRING "Core of the part")
set(_selfcal_fpu_cortex-m4 "-mfpu=fpv4-sp-d16")
set(_selfcal_fpu_cortex-m7 "-mfpu=fpv5-sp-d16")
set(_selfcal_fpu_cortex-m33 "-mfpu=fpv5-sp-d16")
set(_selfcal_flags "-mcpu=${SELFCAL_CPU} -mthumb")
if(DEFINED _selfcal_fpu_${SELFCAL_CPU})
    string(APPEND _selfcal_flags " -mfloat-abi=hard ${_selfcal_fpu_${SELFCAL_CPU}}")
else()
    string(APPEND _selfcal_flags " -mfloat-abi=soft")
endif()
set(CMAKE_C_FLAGS_INIT "${_selfcal_flags} -ffunction-sections -fdata-sections")
set(CMAKE_CXX_FLAGS_INIT "${CMAKE_C_FLAGS_INIT} -fno-exceptions -fno-rtti")
set(CMAKE_EXE_LINKER_FLAGS_INIT "-Wl,--gc-sections")
