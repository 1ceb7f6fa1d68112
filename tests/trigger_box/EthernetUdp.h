#include "Ethernet.h"
