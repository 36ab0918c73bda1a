# find_package(selfcal): the target selfcal::selfcal with the default tables, and selfcal_add_library().
include("${CMAKE_CURRENT_LIST_DIR}/selfcal.cmake")
if(NOT TARGET selfcal::selfcal)
    selfcal_add_library(selfcal)
    add_library(selfcal::selfcal ALIAS selfcal)
endif()
