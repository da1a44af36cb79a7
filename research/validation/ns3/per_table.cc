// The packet error rates of ns-3's TableBasedErrorRateModel over white noise: a line "kind mcs bytes snr_db per" each.
//
// kind he: HE MCS 0 ... 11, LDPC, 80 MHz, one stream. kind legacy: 802.11a 6 ... 48 Mb/s, convolutional code; its mcs is
// the HE MCS of the same modulation and code rate. Compiled and read by per_fit.py.

#include <cmath>
#include <iostream>
#include <vector>

#include "ns3/core-module.h"
#include "ns3/wifi-module.h"

using namespace ns3;

static void
Print(const char* kind, int mcs, WifiMode mode, bool legacy, const std::vector<unsigned>& lengths)
{
    auto model = CreateObject<TableBasedErrorRateModel>();
    WifiTxVector v;
    v.SetMode(mode);
    v.SetPreambleType(legacy ? WIFI_PREAMBLE_LONG : WIFI_PREAMBLE_HE_SU);
    v.SetChannelWidth(legacy ? 20 : 80);
    v.SetGuardInterval(NanoSeconds(800));
    v.SetNss(1);
    v.SetLdpc(!legacy);
    for (unsigned bytes : lengths)
    {
        for (int k = -80; k < 360; ++k)
        {
            double snr = k * 0.1;
            double ok = model->GetChunkSuccessRate(mode, v, std::pow(10.0, snr / 10.0), 8 * bytes);
            std::cout << kind << ' ' << mcs << ' ' << bytes << ' ' << snr << ' ' << 1.0 - ok << '\n';
        }
    }
}

int
main()
{
    for (int mcs = 0; mcs < 12; ++mcs)
    {
        Print("he", mcs, HePhy::GetHeMcs(mcs), false, {1458, 1494});
    }
    const std::vector<WifiMode> legacy{OfdmPhy::GetOfdmRate6Mbps(),
                                       OfdmPhy::GetOfdmRate12Mbps(),
                                       OfdmPhy::GetOfdmRate18Mbps(),
                                       OfdmPhy::GetOfdmRate24Mbps(),
                                       OfdmPhy::GetOfdmRate36Mbps(),
                                       OfdmPhy::GetOfdmRate48Mbps(),
                                       OfdmPhy::GetOfdmRate54Mbps()};
    for (size_t mcs = 0; mcs < legacy.size(); ++mcs)
    {
        Print("legacy", static_cast<int>(mcs), legacy[mcs], true, {200, 334, 399});
    }
}
