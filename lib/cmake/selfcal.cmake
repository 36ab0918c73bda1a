# The library for any CMake: `selfcal_add_library(NAME [TABLES])`.
cmake_minimum_required(VERSION 3.17)

# RESULT_SOURCES and RESULT_INCLUDES: what the library with these tables is compiled from. TABLES: the folder that
# `selfcal codegen` wrote, relative to the caller's folder; without it the default tables.
function(selfcal_files result)
    get_filename_component(library "${CMAKE_CURRENT_FUNCTION_LIST_DIR}/.." ABSOLUTE)
    set(tables "${library}/default")
    if(ARGC GREATER 1 AND NOT "${ARGV1}" STREQUAL "")
        get_filename_component(tables "${ARGV1}" ABSOLUTE)
    endif()
    foreach(name selfcal_config.h selfcal_model.h selfcal_model.c)
        if(NOT EXISTS "${tables}/${name}")
            message(FATAL_ERROR "selfcal: ${tables} has no ${name}: `selfcal codegen MODEL.yaml -o ${tables}` makes it")
        endif()
    endforeach()
    file(GLOB sources "${library}/*.c")
    set(${result}_SOURCES ${sources} "${tables}/selfcal_model.c" PARENT_SCOPE)
    set(${result}_INCLUDES "${tables}" "${library}" PARENT_SCOPE)
endfunction()

# A static library target of this name. It is compiled in the caller's build, so with the caller's compiler.
function(selfcal_add_library name)
    get_property(languages GLOBAL PROPERTY ENABLED_LANGUAGES)
    if(NOT C IN_LIST languages)
        message(FATAL_ERROR "selfcal is written in C: project(... LANGUAGES C) has to name it")
    endif()
    selfcal_files(selfcal ${ARGN})
    add_library(${name} STATIC EXCLUDE_FROM_ALL ${selfcal_SOURCES})
    target_include_directories(${name} PUBLIC ${selfcal_INCLUDES})
    # Host and target round alike without fused multiply-adds.
    target_compile_options(${name} PRIVATE $<$<NOT:$<C_COMPILER_ID:MSVC>>:-ffp-contract=off>)
    set_target_properties(${name} PROPERTIES C_STANDARD 99 C_STANDARD_REQUIRED ON)
    if(NOT WIN32)
        target_link_libraries(${name} PUBLIC m)
    endif()
endfunction()
