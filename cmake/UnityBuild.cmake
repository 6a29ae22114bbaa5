# Compiles many files as one: what they share of Eigen's templates is compiled once, which is quicker from scratch. After an edit there
# is more to compile than a file, so the presets for daily work go without. Names that are local to a file differ from those of its
# neighbours.
option(GP2_UNITY_BUILD "Compile each room of the library, and some files of the rest, as one file" OFF)

# Some files of a target as one: enough to share templates, few enough for several processors.
function(gp2_compile_in_batches target)
  set_target_properties(${target} PROPERTIES UNITY_BUILD ${GP2_UNITY_BUILD} UNITY_BUILD_BATCH_SIZE 5)
endfunction()

# All files of a room as one. Sources have relative names, ROOM/FILE.cpp.
function(gp2_compile_by_room target)
  if(NOT GP2_UNITY_BUILD)
    return()
  endif()
  get_target_property(sources ${target} SOURCES)
  foreach(source IN LISTS sources)
    # matrices of many fixed sizes: here the files share little
    if(source MATCHES "^([a-z]+)/[a-z_]+\\.cpp$" AND NOT CMAKE_MATCH_1 STREQUAL "smoothing")
      set_source_files_properties(${source} PROPERTIES UNITY_GROUP ${CMAKE_MATCH_1})
    endif()
  endforeach()
  set_target_properties(${target} PROPERTIES UNITY_BUILD ON UNITY_BUILD_MODE GROUP)
endfunction()
