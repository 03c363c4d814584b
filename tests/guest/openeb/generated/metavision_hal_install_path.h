#pragma once
#include <filesystem>
#include <string>
#include <vector>
namespace Metavision {
static const std::filesystem::path HAL_INSTALL_SUPPORT_RELATIVE_PATH = "share";
static const std::filesystem::path HAL_INSTALL_PLUGIN_RELATIVE_PATH  = "lib/metavision/hal/plugins";
static const std::string METAVISION_HAL_LIB_RELATIVE_PATH = "lib/libmetavision_hal.so";
inline std::vector<std::filesystem::path> get_root_installation_path_candidates() { return {"/usr/local", "/usr"}; }
}
